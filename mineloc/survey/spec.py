"""`survey.toml`: which flights, what is done with them, where the results go.

title = "Level 4, October"          # all keys but the flights have defaults
out = "results"                     # beside the survey file
methods = ["odometry", "loam"]

[config.odometry]                   # any configuration section, for all flights
use_imu = true

[[flight]]
name = "north"
recording = "bags/north.mcap"       # a recording ...
reference = "truth/north.tum"       # ... with a reference of its own, if the flight carries none

[[flight]]
name = "rehearsal"
mine = "demo"                       # ... or a mine to fly through: built-in name, mesh or plan
[flight.config.simulate]            # configuration of this flight alone
length_m = 500

[[flight]]
name = "night"
recording = "bags/night.mcap"
methods = ["map_tracking"]          # in place of the survey's; [] for a flight that only makes a map
map = "level-4"                     # in which methods that know a map localize it
[flight.config.prior_map]
start_m = [512_000, 4_398_000, -350] # where it begins; without it the intersections of the map find it

[[map]]                             # a map of some of the flights (of all that use none, without the key)
name = "level-4"
flights = ["north"]
control = "survey/targets.csv"      # surveyed targets, and where flights saw them; else what the flights bring
observations = "survey/seen.csv"
intersections = true                # also make the database of its intersections

Before the first table, `dataset = "level4@2026-11"` adds every flight of that version of a dataset, with its recording
from the store (`store = "..."` beside the file, else the one that all commands take); a `[[flight]]` of the same name
then only refines it. The results are kept in that store too.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from mineloc.config import Config, Section, layered_config, read_toml, validate
from mineloc.errors import ConfigError
from mineloc.store.versions import NAME
from mineloc.survey.dataset_flights import DatasetFlights, dataset_flights
from mineloc.survey.methods import KNOW_A_MAP


class FlightSpec(Section):
    """One flight of a survey; paths as written in the file."""

    name: str = Field(pattern=rf"^{NAME}$", max_length=100)
    recording: str | None = None
    sequence: str | None = None
    mine: str | None = None
    graph: str | None = None
    reference: str | None = None
    methods: tuple[str, ...] | None = None
    map: str | None = Field(default=None, description="of the survey, in which methods that know a map localize it")
    config: dict[str, Any] = Field(default_factory=dict)


class MapSpec(Section):
    """One map of a survey; paths as written in the file."""

    name: str = Field(pattern=rf"^{NAME}$", max_length=100)
    flights: tuple[str, ...] = ()
    method: str = "odometry_loops"
    control: str | None = None
    observations: str | None = None
    intersections: bool = Field(default=False, description="also make the database of its intersections")


class SurveySpec(Section):
    """The file as it is written."""

    title: str = ""
    out: str | None = None
    methods: tuple[str, ...] = Field(default=("odometry",), min_length=1)
    workers: int = Field(default=2, ge=1, le=64, description="processes at work at the same time")
    config: dict[str, Any] = Field(default_factory=dict)
    dataset: str | None = Field(default=None, description="a version of one, whose flights are flown too")
    store: str | None = Field(default=None, description="where the dataset is kept")
    flight: tuple[FlightSpec, ...] = ()
    map: tuple[MapSpec, ...] = ()


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight, ready to be planned: either `recording` or `mine` is set.

    Attributes:
        mine: a file, or the name of a built-in mine.
        graph: the roadway graph of a mesh, in place of the one found in it.
        methods: that localize it; None: the survey's.
        map: name of the map for those that know one; None: it has none.
    """

    name: str
    recording: Path | None
    sequence: Path | None
    mine: Path | str | None
    graph: Path | None
    reference: Path | None
    config: Config
    methods: tuple[str, ...] | None = None
    map: str | None = None


@dataclass(frozen=True, slots=True)
class Map:
    """One map, ready to be planned.

    Attributes:
        flights: names of flights of the survey, at least one.
        method: front end and loop closures.
        control, observations: files; None: what the flights bring.
        intersections: a database of its intersections is made too.
    """

    name: str
    flights: tuple[str, ...]
    method: str
    control: Path | None
    observations: Path | None
    intersections: bool


@dataclass(frozen=True, slots=True)
class Survey:
    """A survey whose files exist and whose configuration is valid.

    Attributes:
        path: the survey file.
        out: the folder for the results.
        methods: of flights that name none of their own.
        config: what holds for the survey as a whole (the report).
        store: of its dataset, where results are kept too; None: in its own folder.
    """

    path: Path
    title: str
    out: Path
    methods: tuple[str, ...]
    workers: int
    flights: tuple[Flight, ...]
    config: Config
    maps: tuple[Map, ...] = ()
    store: Path | None = None

    def methods_of(self, flight: Flight) -> tuple[str, ...]:
        """By which a flight is localized, each once."""
        return self.methods if flight.methods is None else flight.methods


def read_survey(path: Path, overrides: Iterable[str] = (), *, out: Path | None = None) -> Survey:
    """Read a survey file.

    Args:
        overrides: `section.key=value`, over the configuration of every flight.
        out: where the results go, over the file's own word.

    Raises:
        ConfigError: not TOML, an unknown key, no such dataset, a value that does not fit, a file that does not exist,
            two flights of one name, a method that needs a map on a flight that has none or is part of it.
    """
    spec = read_spec(path)
    known = None if spec.dataset is None else dataset_flights(path, spec.dataset, spec.store)
    if known is not None:
        spec = _with_dataset(path, spec, known)
    elif spec.store is not None:
        raise ConfigError(path, "a store without a dataset", expected='dataset = "name@tag"', todo="add it")
    if not spec.flight:
        raise ConfigError(path, "no flight", expected="a [[flight]], or a dataset with one", todo="add it")
    overrides = list(overrides)
    _refuse_equal_names(path, "flights", [flight.name for flight in spec.flight])
    _refuse_equal_names(path, "maps", [one.name for one in spec.map])
    flights = tuple(_flight(path, flight, spec, overrides) for flight in spec.flight)
    survey = Survey(
        path=path,
        title=spec.title,
        out=_out(path, spec, out),
        methods=tuple(dict.fromkeys(spec.methods)),
        workers=spec.workers,
        flights=flights,
        config=layered_config([spec.config], overrides, where=str(path)),
        maps=tuple(_map(path, one, flights) for one in spec.map),
        store=None if known is None else known.store,
    )
    _refuse_unmapped(survey)
    return survey


def read_spec(path: Path) -> SurveySpec:
    """A survey file as it is written; whether what it names exists is not looked at.

    Raises:
        ConfigError: not TOML, an unknown key, or a value that does not fit.
    """
    return validate(SurveySpec, read_toml(path), where=str(path))


def out_of(path: Path, out: Path | None) -> Path:
    """The folder for the results of a survey file.

    Args:
        out: over the file's own word.

    Raises:
        ConfigError: as `read_spec`.
    """
    return _out(path, read_spec(path), out)


def _out(path: Path, spec: SurveySpec, out: Path | None) -> Path:
    return out if out is not None else path.parent / (spec.out or f"{path.stem}.results")


def _with_dataset(path: Path, spec: SurveySpec, known: DatasetFlights) -> SurveySpec:
    """The flights of the dataset, each as the file refines it, before those that the file alone names."""
    told = {flight.name: flight for flight in spec.flight}
    flights: list[FlightSpec] = []
    for name, (recording, sequence) in known.files.items():
        flight = told.pop(name, FlightSpec(name=name))
        if any(one is not None for one in (flight.recording, flight.mine, flight.graph, flight.sequence)):
            raise ConfigError(
                f"{path}: flight {name}",
                f"its recording comes from dataset {spec.dataset!r}",
                expected="methods, map, config or reference only",
                todo="rename the flight, or take recording, sequence, mine and graph away",
            )
        written = {"recording": str(recording), "sequence": None if sequence is None else str(sequence)}
        flights.append(flight.model_copy(update=written))
    return spec.model_copy(update={"flight": (*flights, *told.values())})


def slug(name: str) -> str:
    """A flight's name in lower case, digits and hyphens, as Prefect wants its keys."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def _flight(path: Path, spec: FlightSpec, survey: SurveySpec, overrides: list[str]) -> Flight:
    where = f"{path}: flight {spec.name}"
    if (spec.recording is None) == (spec.mine is None):
        raise ConfigError(where, "needs a recording or a mine", expected="one of the two", todo="correct the survey")
    return Flight(
        name=spec.name,
        recording=_existing(path, where, "recording", spec.recording),
        sequence=_existing(path, where, "sequence", spec.sequence),
        mine=_mine(path, where, spec.mine),
        graph=_existing(path, where, "graph", spec.graph),
        reference=_existing(path, where, "reference", spec.reference),
        config=layered_config([survey.config, spec.config], overrides, where=where),
        methods=None if spec.methods is None else tuple(dict.fromkeys(spec.methods)),
        map=spec.map,
    )


def _mine(survey: Path, where: str, written: str | None) -> Path | str | None:
    """A word without folder and suffix names a built-in mine; which there are, simulation knows."""
    if written is not None and re.fullmatch(r"[\w-]+", written) and not (survey.parent / written).exists():
        return written
    return _existing(survey, where, "mine", written)


def _existing(survey: Path, where: str, key: str, written: str | None) -> Path | None:
    if written is None:
        return None
    found = survey.parent / written
    if not found.exists():
        raise ConfigError(
            where, f"{key} = {written!r}: no such file", expected="a path beside the survey file", todo="check the path"
        )
    return found


def _map(path: Path, spec: MapSpec, flights: Sequence[Flight]) -> Map:
    where = f"{path}: map {spec.name}"
    names = [flight.name for flight in flights]
    for name in spec.flights:
        if name not in names:
            raise ConfigError(
                where, f"no flight {name!r}", expected=f"one of {', '.join(names)}", todo="correct the survey"
            )
    others = tuple(flight.name for flight in flights if flight.map != spec.name)
    if not spec.flights and not others:
        raise ConfigError(
            where, "all flights are localized in it", expected="flights of which it is made", todo="name them"
        )
    return Map(
        name=spec.name,
        flights=spec.flights or others,
        method=spec.method,
        control=_existing(path, where, "control", spec.control),
        observations=_existing(path, where, "observations", spec.observations),
        intersections=spec.intersections,
    )


def _refuse_unmapped(survey: Survey) -> None:
    """Methods that know a map have one, with a database where they need it, and not of the flight itself."""
    if not any(survey.methods_of(flight) for flight in survey.flights):
        raise ConfigError(survey.path, "no flight is localized", expected="a method on one flight", todo="name one")
    for flight in survey.flights:
        where = f"{survey.path}: flight {flight.name}"
        needy = [method for method in survey.methods_of(flight) if method in KNOW_A_MAP]
        if flight.map is None:
            if needy:
                raise ConfigError(where, f"{needy[0]} needs a map", expected='map = "NAME" of a [[map]]', todo="add it")
            continue
        chosen = next((one for one in survey.maps if one.name == flight.map), None)
        if chosen is None:
            names = ", ".join(one.name for one in survey.maps) or "a [[map]] in the survey"
            raise ConfigError(where, f"no map {flight.map!r}", expected=names, todo="correct the survey")
        if flight.name in chosen.flights:
            raise ConfigError(
                where,
                f"map {chosen.name!r} is made of it",
                expected="a map of other flights",
                todo="correct the survey",
            )
        if "intersections_map" in needy and not chosen.intersections:
            raise ConfigError(
                where,
                f"intersections_map needs the intersections of map {chosen.name!r}",
                expected="intersections = true there",
                todo="add it",
            )


def _refuse_equal_names(path: Path, what: str, names: list[str]) -> None:
    seen: dict[str, str] = {}
    for name in names:
        if slug(name) in seen:
            raise ConfigError(
                path,
                f"{what} {seen[slug(name)]!r} and {name!r}",
                expected="names that differ in letters or digits",
                todo="rename one",
            )
        seen[slug(name)] = name
