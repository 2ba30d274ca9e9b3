"""The health of a recording before it becomes part of a dataset: what ingest says, kept like any result.

There is no cheaper way than ingest itself; a survey on the dataset then finds the flight made.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mineloc.io.flight_reader import FlightReader
from mineloc.progress import Progress, quiet
from mineloc.stages.stage import Input, Job
from mineloc.store.store import Store
from mineloc.survey.registry import INGEST


def health_report(
    store: Store,
    flight: str,
    recording: Path,
    *,
    sequence: Path | None = None,
    progress: Progress = quiet,
    waiting: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """The health report of a recording, with the model of its LiDAR as `sensor`.

    Args:
        sequence: what the recording does not say about itself.
        waiting: called once when another process ingests it.

    Raises:
        IngestError, ConfigError: as ingest.
        StoreError: the recording changed meanwhile.
        OutputError: the store cannot be written.
    """
    inputs = {"recording": Input(recording, store.source(recording), is_source=True)}
    if sequence is not None:
        inputs["sequence"] = Input(sequence, store.source(sequence), is_source=True)
    outcome = Job(INGEST, f"{flight}.mcap", inputs).run(store, progress=progress, waiting=waiting)
    with FlightReader(store.objects.path(outcome.output.digest)) as reader:
        return {**reader.health, "sensor": reader.info.lidar}
