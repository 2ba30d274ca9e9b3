"""A survey without Prefect: steps run as soon as what they need is there, a failed one stops only what needs it."""

from __future__ import annotations

from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

from mineloc.errors import MinelocError
from mineloc.store.store import Outcome
from mineloc.survey.engine import engine
from mineloc.survey.events import Listener
from mineloc.survey.plan import Plan, Step
from mineloc.survey.runner import PROCESSES, Runner


def run_local(plan: Plan, listener: Listener, runner: Runner = PROCESSES) -> dict[str, Outcome]:
    """Run all steps; the outcomes by step name.

    Raises:
        MinelocError: of the first step that failed, after everything that does not need it is done.
    """
    made: dict[str, Outcome] = {}
    errors: list[MinelocError] = []
    left = list(plan.steps)
    running: dict[Future[Outcome], Step] = {}
    # A thread waits for a process; the workers are closed first, so that no thread waits for ever.
    at_once = runner.at_once(plan.workers) + 1
    with ThreadPoolExecutor(max_workers=at_once) as threads, engine(plan, listener, runner) as work:
        while True:
            for step in [step for step in left if all(name in made for name in step.needs())]:
                left.remove(step)
                running[threads.submit(work.run, step, made)] = step
            if not running:
                break
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                step = running.pop(future)
                try:
                    made[step.name] = future.result()
                except MinelocError as error:
                    errors.append(error)
    if errors:
        raise errors[0]
    return made
