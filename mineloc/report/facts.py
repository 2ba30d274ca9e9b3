"""What a report says of one run, as plain JSON values: the page and its sidecar are both made from this.

Nothing here is rounded and nothing is NaN: what is not known is None.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mineloc.config import EvaluateConfig
from mineloc.io.health import SCHEMA as HEALTH_SCHEMA
from mineloc.report.along import Way
from mineloc.report.limits import limits_of_validity
from mineloc.report.recognitions import map_facts, recognition_facts
from mineloc.stages.comparison import Comparison, compare
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.stretches import Stretch, degenerate_stretches, untrusted_stretches

IDENTITY = ("flight", "site", "level", "drone", "lidar", "imu", "operator", "start_utc", "calibration", "source")


@dataclass(frozen=True, slots=True, eq=False)
class RunFacts:
    """A run, opened and compared.

    Attributes:
        run: the folder.
        comparisons: `online` and `smoothed` beside the reference, empty without one.
        values: everything that the page prints of it.
    """

    run: RunFolder
    comparisons: dict[str, Comparison]
    values: dict[str, Any]

    @property
    def way(self) -> Way:
        """What metres flown are counted along: the compared poses of the reference, else the smoothed estimate."""
        one = self.comparisons.get("smoothed")
        if one is not None:
            return Way(one.shown.stamps_ns, one.shown.path_m)
        return Way(self.run.smoothed.stamps_ns, self.run.smoothed.path_m)


def run_facts(run: RunFolder, letter: str, config: EvaluateConfig) -> RunFacts:
    """All facts of one run.

    Args:
        run: opened folder.
        letter: by which the figures name it.
        config: how it is compared.
    """
    comparisons = compare(run, config)
    facts = RunFacts(run, comparisons, {})
    way = facts.way
    values: dict[str, Any] = {
        "letter": letter,
        "folder": run.path.name,
        "identity": _identity(run),
        "size": _size(run),
        "health": _health(run),
        "shown_alignment": comparisons["smoothed"].shown.alignment if "smoothed" in comparisons else None,
        "accuracy": {name: _accuracy(one) for name, one in comparisons.items()} or None,
        "uncertainty": _uncertainty(run),
        "registration": {
            "trusted_share": _share(run.sweeps["trusted"]),
            "degenerate_share": _share(run.sweeps["is_degenerate"]),
            "untrusted": [_stretch(one, way) for one in untrusted_stretches(run.sweeps)],
            "degenerate": [_stretch(one, way) for one in degenerate_stretches(run.sweeps)],
        },
        "map": map_facts(run, way),
        "recognitions": recognition_facts(run, way),
        "timing": _timing(run),
    }
    values["limits"] = limits_of_validity(values, has_reference=run.reference is not None)
    facts.values.update(values)
    return facts


def _identity(run: RunFolder) -> dict[str, Any]:
    manifest = run.manifest
    info = dict(manifest["flight"]["info"])
    canonical = json.dumps(manifest["configuration"], sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return {
        **{name: info.get(name, "") for name in IDENTITY},
        "flight": manifest["flight"]["name"],
        "method": manifest["method"],
        "front_end": manifest["front_end"],
        "mineloc_version": manifest["mineloc_version"],
        "flight_sha256": manifest["flight"]["sha256"],
        "configuration_sha256": hashlib.sha256(canonical.encode()).hexdigest(),
    }


def _health(run: RunFolder) -> dict[str, Any] | None:
    health = run.manifest["health"]
    return dict(health) if health and health.get("schema") == HEALTH_SCHEMA else None


def _size(run: RunFolder) -> dict[str, Any]:
    stamps = run.sweeps["stamp_ns"].to_numpy()
    reference = run.reference
    return {
        "sweeps": len(run.sweeps),
        "poses": len(run.smoothed),
        "pose_share": len(run.smoothed) / len(run.sweeps),
        "keyframes": len(run.keyframes),
        "duration_s": float((stamps[-1] - stamps[0]) * 1e-9),
        "path_m": float(run.smoothed.path_m[-1]),
        "reference_path_m": None if reference is None else float(reference.path_m[-1]),
    }


def _accuracy(one: Comparison) -> dict[str, Any]:
    scores = one.scores.to_dict()
    return {
        "association": scores["association"],
        "coverage": scores["coverage"],
        "ape": {aligned["alignment"]: aligned["ape"] for aligned in scores["aligned"]},
        "rpe": scores["aligned"][0]["rpe"],
        "rep": scores["rep"],
        "segments": scores["segments"],
        "drift": asdict(one.drift),
        "notes": scores["notes"],
    }


def _uncertainty(run: RunFolder) -> dict[str, float] | None:
    """What the estimate claims of itself, one standard deviation at the keyframes; None when it claims nothing."""
    columns = ("sigma_xy_m", "sigma_z_m", "sigma_yaw_deg")
    known = run.keyframes.select(columns).drop_nulls()
    if known.is_empty():
        return None
    out: dict[str, float] = {}
    for column in columns:
        values = known[column].to_numpy()
        out |= {f"{column}_median": float(np.median(values)), f"{column}_max": float(values.max())}
    return out


def _share(column: Any) -> float:
    values = column.fill_null(False).to_numpy()
    return float(values.mean()) if len(values) else 0.0


def _stretch(one: Stretch, way: Way) -> dict[str, Any]:
    start, end = float(way.metres(one.start_ns)), float(way.metres(one.end_ns))
    return {
        "from_m": start,
        "to_m": end,
        "length_m": end - start,
        "from_s": (one.start_ns - int(way.stamps_ns[0])) * 1e-9,
        "duration_s": (one.end_ns - one.start_ns) * 1e-9,
        "sweeps": one.sweeps,
        "reason": one.reason,
    }


def _timing(run: RunFolder) -> dict[str, Any]:
    modules = run.timing["modules"]
    return {
        "modules": [{"name": name, **modules[name]} for name in sorted(modules, key=lambda m: -modules[m]["total_s"])],
        "sweeps_per_s": run.timing["sweeps_per_s"],
        "real_time_factor": run.timing["real_time_factor"],
    }
