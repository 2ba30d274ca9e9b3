"""How sound a recording is: what ingest measured on the way, as a value for tables, JSON and the flight's metadata."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from mineloc.io.recording import Damage

Severity = Literal["info", "warning", "error"]
_ORDER: dict[Severity, int] = {"error": 0, "warning": 1, "info": 2}
SCHEMA = "mineloc.health/1"


@dataclass(frozen=True, slots=True)
class HealthFinding:
    """Something that somebody should know.

    Attributes:
        name: what, as an identifier: `lidar_gaps`.
        severity: "error" spoils results, "warning" may, "info" does not.
        count: how often.
        detail: one line for people.
    """

    name: str
    severity: Severity
    count: int
    detail: str


@dataclass(frozen=True, slots=True)
class TopicHealth:
    """One topic that became part of the flight.

    Attributes:
        role: "lidar", "imu", "reference", "odometry", "depth" or "grey".
        topic, msgtype: as recorded.
        messages: how many the file delivered.
        used: how many are in the flight.
        first_ns, last_ns: header times of the used ones.
        rate_hz: by the median interval; None for fewer than two messages.
        gaps: pauses longer than `ingest.gap_factor` periods.
        missing: messages that the rate would have put into the gaps.
        longest_gap_s: longest interval between two messages.
        backwards, duplicates: messages left out since their time was before, or the same as, that of another.
        clock_jumps: how often the header clock moved against the recorder's by more than 0.5 s at once.
        log_delay_median_s, log_delay_min_s, log_delay_max_s: recorder's time minus header time; None without messages.
    """

    role: str
    topic: str
    msgtype: str
    messages: int
    used: int
    first_ns: int
    last_ns: int
    rate_hz: float | None
    gaps: int
    missing: int
    longest_gap_s: float
    backwards: int
    duplicates: int
    clock_jumps: int
    log_delay_median_s: float | None
    log_delay_min_s: float | None
    log_delay_max_s: float | None

    @property
    def duration_s(self) -> float:
        """From the first to the last message."""
        return (self.last_ns - self.first_ns) * 1e-9


@dataclass(frozen=True, slots=True)
class PointsHealth:
    """The points of the sweeps.

    Attributes:
        median, least, most: points a sweep, after dropping those that are no returns.
        dropped: points that are not finite or at the origin, in all sweeps.
        empty_sweeps: clouds without a single return, left out.
        point_times, rings, intensity: whether the sweeps have them.
    """

    median: int
    least: int
    most: int
    dropped: int
    empty_sweeps: int
    point_times: bool
    rings: bool
    intensity: bool


@dataclass(frozen=True, slots=True)
class Health:
    """The whole answer.

    Attributes:
        source: name of the recording.
        kind: "mcap", "rosbag1" or "rosbag2".
        topics: what was used, LiDAR first.
        points: None without a LiDAR.
        damage: what was broken in the file and what it cost.
        findings: worst first.
        earlier: the record that the recording, a flight already, brought along; None if it was none.
    """

    source: str
    kind: str
    topics: tuple[TopicHealth, ...]
    points: PointsHealth | None
    damage: tuple[Damage, ...]
    findings: tuple[HealthFinding, ...]
    earlier: Mapping[str, Any] | None = None

    @property
    def recovered(self) -> bool:
        """Whether the flight was made from a damaged file, now or earlier: it may lack something."""
        return bool(self.damage) or bool(self.earlier and self.earlier.get("recovered"))

    @property
    def lost_messages(self) -> int:
        """Messages lost to damage, as far as known."""
        return sum(damage.messages or 0 for damage in self.damage)

    @property
    def lost_s(self) -> float:
        """Seconds lost to damage, as far as known."""
        return math.fsum(damage.seconds or 0.0 for damage in self.damage)

    @property
    def duration_s(self) -> float:
        """From the first to the last header time of all topics."""
        if not self.topics:
            return 0.0
        return (max(t.last_ns for t in self.topics) - min(t.first_ns for t in self.topics)) * 1e-9

    @property
    def worst(self) -> Severity | None:
        """The worst severity, None when nothing was found."""
        return min((f.severity for f in self.findings), key=lambda s: _ORDER[s], default=None)

    def to_json_dict(self) -> dict[str, Any]:
        """All of it as JSON values; numbers that nobody knows are null."""
        return {
            "schema": SCHEMA,
            "source": self.source,
            "kind": self.kind,
            "duration_s": self.duration_s,
            "recovered": self.recovered,
            "lost_messages": self.lost_messages,
            "lost_s": self.lost_s,
            "topics": [asdict(topic) for topic in self.topics],
            "points": None if self.points is None else asdict(self.points),
            "damage": [{**asdict(damage), "text": damage.describe()} for damage in self.damage],
            "findings": [asdict(finding) for finding in self.findings],
            "earlier": None if self.earlier is None else dict(self.earlier),
        }

    def flight_record(self) -> Mapping[str, Any]:
        """What the flight's metadata say: a flight that was whole when it was read keeps what it had."""
        return self.earlier if self.earlier and not self.damage else self.to_json_dict()


def sorted_findings(findings: Sequence[HealthFinding]) -> tuple[HealthFinding, ...]:
    """Worst first, else in the order given."""
    return tuple(sorted(findings, key=lambda finding: _ORDER[finding.severity]))
