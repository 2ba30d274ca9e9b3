"""Absolute pose error (APE): pose against pose, after alignment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mineloc import se3
from mineloc.data import F64, I64
from mineloc.metrics.alignment import Alignment, alignment
from mineloc.metrics.association import Pairs
from mineloc.metrics.relative import turn_deg
from mineloc.metrics.statistics import Statistics


@dataclass(frozen=True, slots=True, eq=False)
class AbsoluteError:
    """APE of one estimate under one alignment, and the error along the flight.

    Attributes:
        alignment: what was done before.
        T_reference_estimate: (4, 4) the transform of that alignment.
        translation_m, rotation_deg: statistics over the pairs.
        stamps_ns: (n,) times of the pairs.
        path_m: (n,) distance along the reference.
        error_m: (n,) distance of the positions (evo's `translation_part`).
        error_deg: (n,) angle between the orientations (evo's `rotation_angle_deg`).
        offset_m: (n, 3) estimate minus reference in the reference's frame.
    """

    alignment: Alignment
    T_reference_estimate: F64
    translation_m: Statistics
    rotation_deg: Statistics
    stamps_ns: I64
    path_m: F64
    error_m: F64
    error_deg: F64
    offset_m: F64

    def to_dict(self) -> dict[str, Any]:
        """The statistics, without the arrays along the flight."""
        return {"translation_m": self.translation_m.to_dict(), "rotation_deg": self.rotation_deg.to_dict()}


def absolute_error(pairs: Pairs, kind: Alignment) -> AbsoluteError:
    """APE after alignment.

    Raises:
        ValueError: no pairs, or the alignment is not determined (see `alignment`).
    """
    T = alignment(pairs.reference, pairs.estimate, kind)
    estimate = T @ pairs.estimate
    offset = estimate[:, :3, 3] - pairs.reference[:, :3, 3]
    error_m = np.linalg.norm(offset, axis=1)
    error_deg = turn_deg(se3.inverse(pairs.reference) @ estimate)
    return AbsoluteError(
        alignment=kind,
        T_reference_estimate=T,
        translation_m=Statistics.of(error_m),
        rotation_deg=Statistics.of(error_deg),
        stamps_ns=pairs.stamps_ns,
        path_m=pairs.reference_path_m,
        error_m=error_m,
        error_deg=error_deg,
        offset_m=offset,
    )
