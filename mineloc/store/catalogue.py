"""Tables of what a store holds: flights by version, and the figures of all runs on them.

`catalogue/flights.parquet` and `catalogue/runs.parquet` are made of manifests, health reports and action records alone;
they may be deleted at any time. A run belongs to a flight if it was ingested from the same recording with the same
sequence file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from mineloc.output import new_file
from mineloc.store.dataset_reader import DatasetReader
from mineloc.store.digest import canonical_json, sha256_of_text
from mineloc.store.health import duration_s, verdict
from mineloc.store.record import Action, Record
from mineloc.store.results import all_records
from mineloc.store.versions import Recording, Version

FLIGHTS: dict[str, Any] = {
    "dataset": pl.String,
    "version": pl.String,
    "flight": pl.String,
    "file": pl.String,
    "sha256": pl.String,
    "bytes": pl.Int64,
    "sequence": pl.String,
    "duration_s": pl.Float64,
    "sensor": pl.String,
    "health": pl.String,
}
METRICS = ("rmse_m", "max_m", "rmse_deg", "rep_5_percent", "kitti_percent", "coverage_percent", "trusted_percent")
RUNS: dict[str, Any] = {
    "dataset": pl.String,
    "version": pl.String,
    "flight": pl.String,
    "sha256": pl.String,
    "method": pl.String,
    "trajectory": pl.String,
    "alignment": pl.String,
    "code": pl.String,
    "config": pl.String,
    "run": pl.String,
    "utc": pl.String,
    **dict.fromkeys(METRICS, pl.Float64),
}


@dataclass(frozen=True, slots=True)
class Catalogue:
    """The two tables.

    Attributes:
        flights: a row a version and flight; duration, sensor and health are null without a report.
        runs: a row a version, flight, run, trajectory and alignment; what is unknown is null. `code` and `config` are
            those of localization.
    """

    flights: pl.DataFrame
    runs: pl.DataFrame


def rebuild(datasets: DatasetReader) -> Catalogue:
    """Make the tables anew and keep them.

    Raises:
        StoreError: a reference, a manifest or a report is gone or damaged.
        OutputError: the store cannot be written.
    """
    found = _tables(datasets)
    for name, table in (("flights", found.flights), ("runs", found.runs)):
        with new_file(_path(datasets, name), overwrite=True) as temp:
            table.write_parquet(temp)
    return found


def read_catalogue(datasets: DatasetReader) -> Catalogue:
    """The tables as they were kept; made anew if they are not there or cannot be read.

    Raises:
        StoreError, OutputError: as `rebuild`.
    """
    try:
        found = Catalogue(pl.read_parquet(_path(datasets, "flights")), pl.read_parquet(_path(datasets, "runs")))
    except (OSError, pl.exceptions.PolarsError):
        return rebuild(datasets)
    same = dict(found.flights.schema) == FLIGHTS and dict(found.runs.schema) == RUNS
    return found if same else rebuild(datasets)


def _path(datasets: DatasetReader, table: str) -> Path:
    return datasets.store.root / "catalogue" / f"{table}.parquet"


def _tables(datasets: DatasetReader) -> Catalogue:
    versions = [(name, version) for name in datasets.refs.datasets() for version in datasets.versions(name)]
    runs = list(_runs(datasets))
    flights = [_flight_row(datasets, name, version, one) for name, version in versions for one in version.recordings]
    rows = [
        {"dataset": name, "version": version.id, "flight": one.flight, "sha256": one.sha256} | figures
        for name, version in versions
        for one in version.recordings
        for run in runs
        if (run.recording, run.sequence) == (one.sha256, one.sequence)
        for figures in run.rows
    ]
    tables = Catalogue(pl.DataFrame(flights, schema=FLIGHTS), pl.DataFrame(rows, schema=RUNS, strict=False).unique())
    return Catalogue(
        tables.flights.sort("dataset", "version", "flight"),
        tables.runs.sort("dataset", "version", "flight", "method", "run", "trajectory", "alignment", nulls_last=True),
    )


def _flight_row(datasets: DatasetReader, name: str, version: Version, one: Recording) -> dict[str, Any]:
    report = datasets.health(one)
    return {
        "dataset": name,
        "version": version.id,
        "flight": one.flight,
        "file": one.file,
        "sha256": one.sha256,
        "bytes": one.bytes,
        "sequence": one.sequence,
        "duration_s": None if report is None else duration_s(report),
        "sensor": None if report is None else (report.get("sensor") or None),
        "health": None if report is None else verdict(report),
    }


@dataclass(frozen=True, slots=True)
class _Run:
    """The figures of a run and of what it was made."""

    recording: str
    sequence: str | None
    rows: list[dict[str, Any]]


def _runs(datasets: DatasetReader) -> Iterator[_Run]:
    """Evaluations, followed back over localization and ingest to their recordings."""
    records = all_records(datasets.store).values()
    made: dict[tuple[str, str], list[tuple[Action, Record]]] = {}
    for action, record in records:
        made.setdefault((action.stage, record.output.digest), []).append((action, record))
    for evaluate, scored in (entry for entry in records if entry[0].stage == "evaluate"):
        for localize, run in made.get(("localize", _only(evaluate, "run") or ""), ()):
            for ingest, _ in made.get(("ingest", _only(localize, "flight") or ""), ()):
                recording = _only(ingest, "recording")
                if recording is not None:
                    rows = list(_run_rows(datasets, localize, run, scored))
                    yield _Run(recording, _only(ingest, "sequence"), rows)


def _only(action: Action, name: str) -> str | None:
    return next((digest for _, digest in action.inputs.get(name, ())), None)


def _run_rows(datasets: DatasetReader, localize: Action, run: Record, scored: Record) -> Iterator[dict[str, Any]]:
    found: Any = json.loads(datasets.store.objects.read_text(scored.output.digest))
    common: dict[str, Any] = {
        "method": str(localize.arguments.get("method", "")),
        "code": localize.code,
        "config": sha256_of_text(canonical_json(localize.config)),
        "run": run.output.digest,
        "utc": run.made.get("utc"),
        "trusted_percent": _percent(found.get("trusted_share")),
    }
    for one in found["trajectories"]:
        for aligned in one["aligned"]:
            yield (
                common | {"trajectory": one["name"], "alignment": aligned["alignment"]} | _figures(one, aligned["ape"])
            )
    if not found["trajectories"]:
        yield common


def _figures(one: Mapping[str, Any], ape: Mapping[str, Any]) -> dict[str, float | None]:
    turns: Mapping[str, Any] = ape["rotation_deg"] or {}
    return {
        "rmse_m": ape["translation_m"]["rmse"],
        "max_m": ape["translation_m"]["max"],
        "rmse_deg": turns.get("rmse"),
        "rep_5_percent": _rep(one["rep"]),
        "kitti_percent": one["segments"]["percent"],
        "coverage_percent": _percent(one["coverage"]["time"]),
    }


def _rep(entries: list[dict[str, Any]]) -> float | None:
    """REP over the whole path, as the evaluation's table shows it."""
    last = next((one for one in entries if one["percent_of_path"] == 100), None)
    literal = None if last is None else last["literal"]
    return None if literal is None else literal["mean"]


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share
