"""What a health report (the JSON of ingest, `mineloc.health/1`) says in short."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_WORST = ("error", "warning")


def verdict(report: Mapping[str, Any]) -> str:
    """One word: `recovered` (from a damaged file), `error`, `warning`, or `good`."""
    if report.get("recovered"):
        return "recovered"
    found = {str(finding.get("severity")) for finding in report.get("findings") or ()}
    return next((word for word in _WORST if word in found), "good")


def duration_s(report: Mapping[str, Any]) -> float | None:
    """Seconds from the first to the last measurement, None if it does not say."""
    value = report.get("duration_s")
    return float(value) if isinstance(value, int | float) else None


def topic(report: Mapping[str, Any], role: str) -> Mapping[str, Any]:
    """What it says of the topic with a role (`lidar`, `imu`); empty if there was none."""
    return next((one for one in report.get("topics") or () if one.get("role") == role), {})
