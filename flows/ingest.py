"""Recordings become flights."""

from __future__ import annotations

from flows.step import stage_task

simulate = stage_task("simulate")
ingest = stage_task("ingest")
