"""Mapping flights become maps."""

from __future__ import annotations

from flows.step import stage_task

reconstruct = stage_task("reconstruct")
