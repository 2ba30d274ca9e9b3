"""From a survey to its steps: which stage runs on which input, and where its result is put.

simulate? -> ingest -> localize (a method) -> evaluate, record
                                           -> report (all runs)
                    -> reconstruct (a map of some flights) -> database of its intersections
                                                           -> localize (another flight in it)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from mineloc.config import Config
from mineloc.stages.stage import Input, Job, Stage
from mineloc.store.digest import Json
from mineloc.store.store import Outcome, Store
from mineloc.survey.methods import KNOW_A_MAP
from mineloc.survey.registry import DATABASE, EVALUATE, INGEST, LOCALIZE, RECONSTRUCT, RECORD, REPORT, SIMULATE
from mineloc.survey.spec import Flight, Map, Survey

METRICS = "metrics.json"
RECORDING = "run.rrd"


@dataclass(frozen=True, slots=True)
class Made:
    """The result of another step, as an input."""

    step: str


Wanted: TypeAlias = Path | Made


@dataclass(frozen=True)
class Step:
    """One stage of one flight (or of the whole survey).

    Attributes:
        name: unique in the plan, `flight stage` or `flight stage method`.
        flight: its flight, empty for the survey's own.
        to: where the result goes, relative to the survey's folder.
        beside: files in `to` that other steps put there.
    """

    name: str
    flight: str
    stage: Stage
    to: str
    inputs: Mapping[str, Wanted | tuple[Wanted, ...]]
    config: Config
    arguments: Mapping[str, Json] = field(default_factory=dict)
    beside: tuple[str, ...] = ()

    def needs(self) -> list[str]:
        """The names of the steps whose results this one reads."""
        return [one.step for given in self.inputs.values() for one in _group(given) if isinstance(one, Made)]

    def job(self, plan: Plan, store: Store, made: Mapping[str, Outcome]) -> Job:
        """The step on the content of its inputs, of which those outside the store are hashed now.

        Raises:
            StoreError: a source cannot be read.
        """

        def known(one: Wanted) -> Input:
            if isinstance(one, Made):
                return Input(plan.place_of(one.step), made[one.step].output, is_source=False)
            return Input(one, store.source(one), is_source=True)

        return Job(
            stage=self.stage,
            out_name=Path(self.to).name,
            inputs={
                name: tuple(known(one) for one in given) if isinstance(given, tuple) else known(given)
                for name, given in self.inputs.items()
            },
            arguments=self.arguments,
            config=self.config,
        )


@dataclass(frozen=True)
class Run:
    """Where a run of a method on a flight ends up."""

    flight: str
    method: str
    folder: Path

    @property
    def metrics(self) -> Path:
        """The evaluation, as JSON."""
        return self.folder / METRICS

    @property
    def recording(self) -> Path:
        """The Rerun recording."""
        return self.folder / RECORDING


@dataclass(frozen=True)
class Plan:
    """All steps, each after those whose results it reads.

    Attributes:
        out: the survey's folder.
        workers: how many steps run at the same time.
        kept: the store, where it is not in the survey's folder.
    """

    out: Path
    workers: int
    steps: tuple[Step, ...]
    runs: tuple[Run, ...]
    kept: Path | None = None

    def step(self, name: str) -> Step:
        """A step by name."""
        return next(step for step in self.steps if step.name == name)

    def place_of(self, name: str) -> Path:
        """Where the result of a step goes."""
        return self.out / self.step(name).to

    @property
    def state(self) -> Path:
        """Where logs and the flows' history live, and the store if it has no other place."""
        return self.out / ".mineloc"

    @property
    def store(self) -> Path:
        """Where results are kept."""
        return self.kept if self.kept is not None else self.state / "store"

    @property
    def report(self) -> Path:
        """The HTML report."""
        return self.out / "report" / REPORT.inside


def plan_survey(survey: Survey) -> Plan:
    """All steps of a survey, flight after flight, then maps and what is localized in them, the report last."""
    steps: list[Step] = []
    runs: list[Run] = []
    in_maps: list[Step] = []
    known = {one.name: one for one in survey.maps}
    for flight in survey.flights:
        steps.extend(_flight_steps(flight))
        for method in survey.methods_of(flight):
            to = f"runs/{flight.name}-{method}"
            own = known[flight.map] if flight.map is not None and method in KNOW_A_MAP else None
            (steps if own is None else in_maps).extend(_run_steps(flight, method, to, own))
            runs.append(Run(flight.name, method, survey.out / to))
    for one in survey.maps:
        steps.extend(_map_steps(one, survey.config))
    steps.extend(in_maps)
    localized = tuple(Made(_localize(run.flight, run.method)) for run in runs)
    title: dict[str, Json] = {"title": survey.title} if survey.title else {}
    steps.append(Step("report", "", REPORT, "report", {"runs": localized}, config=survey.config, arguments=title))
    return Plan(survey.out, survey.workers, tuple(steps), tuple(runs), survey.store)


def _flight_steps(flight: Flight) -> Iterator[Step]:
    source: Wanted
    if flight.recording is not None:
        source = flight.recording
    else:
        simulate = _simulate_step(flight)
        yield simulate
        source = Made(simulate.name)
    inputs: dict[str, Wanted] = {"recording": source}
    if flight.sequence is not None:
        inputs["sequence"] = flight.sequence
    yield Step(f"{flight.name} ingest", flight.name, INGEST, f"flights/{flight.name}.mcap", inputs, flight.config)


def _simulate_step(flight: Flight) -> Step:
    inputs: dict[str, Wanted] = {}
    arguments: dict[str, Json] = {}
    if isinstance(flight.mine, Path):
        inputs["mine"] = flight.mine
    else:
        arguments["mine"] = flight.mine
    if flight.graph is not None:
        inputs["graph"] = flight.graph
    to = f"recordings/{flight.name}.mcap"
    return Step(f"{flight.name} simulate", flight.name, SIMULATE, to, inputs, flight.config, arguments)


def _run_steps(flight: Flight, method: str, to: str, known: Map | None) -> Iterator[Step]:
    localize = _localize(flight.name, method)
    inputs: dict[str, Wanted] = {"flight": Made(f"{flight.name} ingest")}
    if known is not None and method == "map_tracking":
        inputs["prior_map"] = Made(_reconstruct(known))
    if known is not None and known.intersections:
        inputs["database"] = Made(_database(known))
    yield Step(
        localize,
        flight.name,
        LOCALIZE,
        to,
        inputs,
        flight.config,
        arguments={"method": method},
        beside=(METRICS, RECORDING),
    )
    run: dict[str, Wanted] = {"run": Made(localize)}
    reference = {"reference": flight.reference} if flight.reference is not None else {}
    yield Step(
        f"{flight.name} evaluate {method}", flight.name, EVALUATE, f"{to}/{METRICS}", run | reference, flight.config
    )
    seen = run | {name: inputs[name] for name in ("flight", "database") if name in inputs}
    yield Step(f"{flight.name} record {method}", flight.name, RECORD, f"{to}/{RECORDING}", seen, flight.config)


def _localize(flight: str, method: str) -> str:
    return f"{flight} localize {method}"


def _reconstruct(one: Map) -> str:
    return f"{one.name} reconstruct"


def _database(one: Map) -> str:
    return f"{one.name} database"


def _map_steps(one: Map, config: Config) -> Iterator[Step]:
    inputs: dict[str, Wanted | tuple[Wanted, ...]] = {
        "flights": tuple(Made(f"{name} ingest") for name in one.flights),
    }
    for name, path in (("control", one.control), ("observations", one.observations)):
        if path is not None:
            inputs[name] = path
    to = f"maps/{one.name}"
    yield Step(_reconstruct(one), "", RECONSTRUCT, to, inputs, config, arguments={"method": one.method})
    if one.intersections:
        made: dict[str, Wanted] = {"prior_map": Made(_reconstruct(one))}
        yield Step(_database(one), "", DATABASE, f"{to}.intersections.mcap", made, config)


def _group(given: Wanted | tuple[Wanted, ...]) -> tuple[Wanted, ...]:
    return given if isinstance(given, tuple) else (given,)
