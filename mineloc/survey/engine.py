"""How one step of a plan runs: from its inputs' content to the result in the survey's folder.

Used by the local scheduler and by the Prefect tasks alike; neither knows anything else about a step.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager

from filelock import FileLock, Timeout

from mineloc.errors import MinelocError, OutputError
from mineloc.output import one_line_errors
from mineloc.store.store import Outcome, Store
from mineloc.survey.events import Event, Listener
from mineloc.survey.plan import Plan, Step
from mineloc.survey.pool import StoppedError
from mineloc.survey.runner import PROCESSES, Runner, Workers


class Engine:
    """Runs the steps of one plan, from any thread.

    Args:
        plan: what there is to do.
        store: where results are kept.
        workers: where stages run.
        listener: hears of everything; called from the thread that runs the step.
    """

    def __init__(self, plan: Plan, store: Store, workers: Workers, listener: Listener) -> None:
        self.plan = plan
        self._store = store
        self._workers = workers
        self._listener = listener

    def is_known(self, step: Step, made: Mapping[str, Outcome]) -> bool:
        """Whether the result exists, so that `run` executes nothing."""
        return step.job(self.plan, self._store, made).lookup(self._store) is not None

    def run(self, step: Step, made: Mapping[str, Outcome]) -> Outcome:
        """Make sure that the result of a step exists and lies in the survey's folder.

        Args:
            made: the outcomes of the steps that it needs.

        Raises:
            MinelocError: why there is no result.
        """
        self._listener(Event(step.name, "started"))
        try:
            outcome = self._outcome(step, made)
            self._store.place(outcome.output, self.plan.out / step.to, beside=step.beside)
        except StoppedError:
            raise
        except MinelocError as error:
            self._listener(Event(step.name, "failed", line=error.line()))
            raise
        self._listener(Event(step.name, "known" if outcome.hit else "done", seconds=outcome.seconds))
        return outcome

    def _outcome(self, step: Step, made: Mapping[str, Outcome]) -> Outcome:
        job = step.job(self.plan, self._store, made)
        known = job.lookup(self._store)
        if known is not None:
            return known
        return self._workers.run(
            job,
            self._store.root,
            progress=lambda done, total, unit: self._listener(Event(step.name, "progress", done, total, unit)),
            waiting=lambda: self._listener(Event(step.name, "waiting")),
        )


@contextmanager
def engine(plan: Plan, listener: Listener, runner: Runner = PROCESSES, *, patient: bool = False) -> Generator[Engine]:
    """An engine that works in the survey's folder, which nobody else may meanwhile.

    Args:
        runner: on which workers.
        patient: wait until a run that is at work in the folder is done.

    Raises:
        SurveyError: there are no such workers.
        OutputError: the folder cannot be written, or another survey is at work in it.
    """
    logs = plan.state / "logs"
    with one_line_errors(plan.out):
        logs.mkdir(parents=True, exist_ok=True)
    with _alone(plan, patient=patient):
        store = Store(plan.store)
        store.sweep()
        try:
            with runner.workers(min(plan.workers, len(plan.runs)), logs / "stages.log") as workers:
                yield Engine(plan, store, workers, listener)
        finally:
            store.sweep()


@contextmanager
def _alone(plan: Plan, *, patient: bool) -> Generator[None]:
    lock = FileLock(plan.state / "lock")
    try:
        with one_line_errors(plan.out):
            lock.acquire(timeout=-1 if patient else 0)
    except Timeout:
        raise OutputError(
            plan.out, "another run is at work here", todo="wait until it is done or choose another --out"
        ) from None
    try:
        yield
    finally:
        lock.release()
