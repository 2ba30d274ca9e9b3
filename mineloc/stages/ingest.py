"""The ingest stage: any recording into a canonical flight, with a report on its health."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mineloc.config import Config
from mineloc.errors import OutputError
from mineloc.io.flight_intake import FlightIntake
from mineloc.io.flight_plan import plan_flight
from mineloc.io.flight_writer import FlightWriter
from mineloc.io.health import Health, HealthFinding
from mineloc.io.recording import RawMessage, Recording, Topic
from mineloc.io.recordings import open_recording
from mineloc.io.sequence import Sequence, load_sequence
from mineloc.progress import Progress, quiet

# Calibrations and control points are copied; nobody means a video by an attachment of a flight.
_MAX_ATTACHED_BYTES = 64 << 20


@dataclass(frozen=True, slots=True)
class IngestResult:
    """The flight and what is to know about it."""

    out: Path
    health: Health


def ingest(
    recording: Path,
    *,
    out: Path,
    sequence: Path | None = None,
    config: Config | None = None,
    progress: Progress = quiet,
) -> IngestResult:
    """Make a canonical flight of a recording, as a stream; damaged files are recovered as far as they can be.

    Args:
        recording: an `.mcap`, `.bag` or `.db3` file or a rosbag2 folder.
        out: the flight to make; it appears whole or not at all.
        sequence: a sequence file that tells topics apart and corrects what the recording says.
        config: the `ingest` section is used.
        progress: told of sweeps (poses, where there is no LiDAR).

    Raises:
        IngestError: not a recording, nothing usable in it, or ambiguous.
        ConfigError: the sequence file is wrong.
        OutputError: `out` exists or cannot be written.
    """
    section = (config if config is not None else Config()).ingest
    if out.exists():
        raise OutputError(out, "exists", expected="a new name", todo="choose another --out or remove it")
    told = load_sequence(sequence) if sequence is not None else Sequence()
    with open_recording(recording) as source:
        plan = plan_flight(source, told)
        writer = FlightWriter(
            out, plan.info, plan.calibration, compression=section.compression, chunk_bytes=section.chunk_bytes
        )
        with writer:
            intake = FlightIntake(source, plan, told, writer, section)
            intake.run(_counter(progress, plan.roles.used[0], "sweeps" if intake.lidar is not None else "poses"))
            left_out = _copy_attachments(source, writer)
            health = intake.health(left_out)
            writer.set_health(health.flight_record())
    return IngestResult(out, health)


def _counter(progress: Progress, topic: Topic, unit: str) -> Callable[[RawMessage], None]:
    """Tells the progress by the messages of the topic that matters."""
    done = 0

    def step(raw: RawMessage) -> None:
        nonlocal done
        if raw.topic == topic.name:
            done += 1
            progress(done, topic.count, unit)

    return step


def _copy_attachments(source: Recording, writer: FlightWriter) -> list[HealthFinding]:
    """Copy what is attached to the recording; which attachments were left out."""
    left_out: list[HealthFinding] = []
    names: set[str] = set()
    copied = 0
    for name, media_type, data in source.attachments():
        if name in names or copied + len(data) > _MAX_ATTACHED_BYTES:
            why = "its name is there twice" if name in names else f"more than {_MAX_ATTACHED_BYTES >> 20} MiB in all"
            left_out.append(HealthFinding("attachment_left_out", "warning", 1, f"attachment {name}: {why}"))
            continue
        writer.add_attachment(name, media_type, data)
        names.add(name)
        copied += len(data)
    return left_out
