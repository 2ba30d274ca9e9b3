"""The health of a recording on the terminal."""

from __future__ import annotations

from collections.abc import Iterator

from rich.box import SIMPLE
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from mineloc.io.health import Health, Severity, TopicHealth

_STYLES: dict[Severity, str] = {"error": "bold red", "warning": "yellow", "info": "dim"}


def health_tables(health: Health) -> Iterator[RenderableType]:
    """A row a topic, then the points, the damage and what was found, worst first."""
    yield _topics(health)
    if health.points is not None:
        yield Text(_points_line(health), no_wrap=False)
    if health.recovered:
        yield Text(recovered_line(health), style="bold red")
    for damage in health.damage:
        yield Text(f"damage: {damage.describe()}", style="red")
    for finding in health.findings:
        yield Text(f"{finding.severity}: {finding.detail}", style=_STYLES[finding.severity])


def recovered_line(health: Health) -> str:
    """One line that says that the flight is not whole, or was not read from a whole file."""
    if not health.damage:
        return "this flight was recovered from a damaged recording when it was first ingested"
    unknown = any(damage.open_ended or damage.messages is None for damage in health.damage)
    lost = f"{health.lost_messages} messages and {health.lost_s:.3g} s are lost"
    return f"recovered from a damaged file: {'at least ' if unknown else ''}{lost}"


def _topics(health: Health) -> Table:
    title = f"{health.source} ({health.kind}), {health.duration_s:.1f} s"
    table = Table(box=SIMPLE, title=title, title_justify="left", padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("topic", overflow="fold")
    for name in ("messages", "Hz", "gaps", "missing", "longest", "delay"):
        table.add_column(name, justify="right", no_wrap=True)
    for topic in health.topics:
        table.add_row(*_row(topic))
    return table


def _row(topic: TopicHealth) -> list[str]:
    delay = topic.log_delay_median_s
    used = f"{topic.used:,}" if topic.used == topic.messages else f"{topic.used:,} of {topic.messages:,}"
    return [
        f"{topic.role} {topic.topic}",
        used,
        "" if topic.rate_hz is None else f"{topic.rate_hz:.2f}",
        f"{topic.gaps:,}",
        f"{topic.missing:,}",
        f"{topic.longest_gap_s:.3f} s",
        "" if delay is None else f"{delay:+.3g} s",
    ]


def _points_line(health: Health) -> str:
    points = health.points
    assert points is not None
    has = [name for name, there in (("times", points.point_times), ("rings", points.rings)) if there]
    line = f"points a sweep: median {points.median:,}, {points.least:,} to {points.most:,}"
    line += f", with {' and '.join(has)}" if has else ", without times and rings"
    if points.dropped:
        line += f"; {points.dropped:,} points without return dropped"
    if points.empty_sweeps:
        line += f"; {points.empty_sweeps:,} empty sweeps"
    return line
