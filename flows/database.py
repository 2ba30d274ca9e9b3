"""Maps become databases of their intersections."""

from __future__ import annotations

from flows.step import stage_task

database = stage_task("database")
