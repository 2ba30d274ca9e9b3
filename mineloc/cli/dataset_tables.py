"""What the dataset commands print for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from mineloc.store.dataset_reader import Entry
from mineloc.store.difference import Difference
from mineloc.store.health import duration_s, topic, verdict
from mineloc.store.refs import Move
from mineloc.store.versions import Version

SHORT = 12
_STYLES = {"recovered": "bold red", "error": "bold red", "warning": "yellow", "good": "green"}


def print_table(table: Table) -> None:
    """On standard output, not cut where it is no terminal."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = 200
    console.print(table)


def _table(title: str, words: Sequence[str], numbers: Sequence[str] = (), last: Sequence[str] = ()) -> Table:
    table = Table(box=SIMPLE, title=title or None, title_justify="left", padding=(0, 1, 0, 0), pad_edge=False)
    for name in words:
        table.add_column(name, overflow="fold")
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True)
    for name in last:
        table.add_column(name, overflow="fold")
    return table


def list_table(entries: Iterable[Entry]) -> Table:
    """A row a dataset."""
    table = _table("", ("dataset", "latest"), ("flights", "size", "versions"), ("tags",))
    for one in entries:
        flights, size = str(len(one.latest.recordings)), megabytes(one.latest.bytes)
        table.add_row(one.name, one.latest.id[:SHORT], flights, size, str(one.versions), ", ".join(one.tags) or "–")
    return table


def version_table(name: str, version: Version, reports: Mapping[str, Mapping[str, Any] | None]) -> Table:
    """A row a flight that has an entry in `reports`, with what the report says."""
    title = f"{name}@{version.id[:SHORT]}, {len(version.recordings)} flights, {megabytes(version.bytes)}"
    title += f", follows {version.parent[:SHORT]}" if version.parent else ", the first version"
    title += f": {escape(version.note)}" if version.note else ""
    table = _table(
        title, ("flight", "file", "sha256"), ("size", "s", "LiDAR Hz", "IMU Hz", "gaps", "lost"), ("health",)
    )
    for one in (one for one in version.recordings if one.flight in reports):
        words = (one.flight, escape(one.file), one.sha256[:SHORT], megabytes(one.bytes))
        table.add_row(*words, *_health(reports[one.flight]))
    return table


def _health(report: Mapping[str, Any] | None) -> list[str]:
    if report is None:
        return ["–"] * 6
    lidar, imu = topic(report, "lidar"), topic(report, "imu")
    word = verdict(report)
    return [
        _number(duration_s(report), 1),
        _number(lidar.get("rate_hz"), 2),
        _number(imu.get("rate_hz"), 1),
        _number(lidar.get("gaps"), 0),
        _number(report.get("lost_messages"), 0),
        f"[{_STYLES[word]}]{word}[/]",
    ]


def log_table(moves: Iterable[Move]) -> Table:
    """A row a move of a reference."""
    table = _table("", ("when", "reference", "version", "before", "who"))
    for one in moves:
        versions = [v[:SHORT] if v else "–" for v in (one.version, one.before)]
        table.add_row(one.utc[:19], one.ref, *versions, f"{one.who} on {one.node}")
    return table


def difference_tables(found: Difference) -> Iterable[Table]:
    """The flights, then the figures."""
    title = f"{found.before.dataset}: {found.before.id[:SHORT]} to {found.after.id[:SHORT]}"
    table = _table(title, ("", "flight", "sha256"), ("size",))
    for mark, recordings in (("added", found.added), ("removed", found.removed)):
        for one in recordings:
            table.add_row(mark, one.flight, one.sha256[:SHORT], megabytes(one.bytes))
    for was, now in found.changed:
        table.add_row("changed", now.flight, f"{was.sha256[:SHORT]} to {now.sha256[:SHORT]}", megabytes(now.bytes))
    yield table
    if found.deltas:
        names = ("flight", "method", "poses", "aligned", "figure")
        deltas = _table("figures that differ", names, ("before", "after", "change"))
        for one in found.deltas:
            numbers = (_number(one.before, 4), _number(one.after, 4), f"{one.change:+.4f}")
            deltas.add_row(one.flight, one.method, one.trajectory, one.alignment, one.metric, *numbers)
        yield deltas


def runs_table(rows: Iterable[Mapping[str, Any]]) -> Table:
    """A row a run, trajectory and alignment."""
    numbers = ("rmse_m", "max_m", "rep_5_percent", "kitti_percent", "coverage_percent")
    table = _table("", ("flight", "method", "poses", "aligned", "run"), numbers)
    for row in rows:
        words = (row["flight"], row["method"], row["trajectory"] or "–", row["alignment"] or "–", row["run"][:SHORT])
        table.add_row(*words, *(_number(row[name], 4) for name in numbers))
    return table


def megabytes(size: int) -> str:
    """A size for people."""
    return f"{size / 1e6:,.1f} MB" if size >= 100_000 else f"{size:,} B"


def _number(value: Any, digits: int) -> str:
    return "–" if value is None else f"{value:,.{digits}f}"
