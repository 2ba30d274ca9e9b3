"""What is said about a list of errors."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from mineloc.data import F64


@dataclass(frozen=True, slots=True)
class Statistics:
    """evo's statistics of errors that are not negative. `rmse² = mean² + std²` always.

    `std` has no degrees of freedom taken off (ddof 0). Paper A's "MAE" is `max` (METHOD D10).
    """

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float
    count: int

    @staticmethod
    def of(errors: F64) -> Statistics:
        """Statistics of (n,) errors.

        Raises:
            ValueError: no errors.
        """
        if not len(errors):
            raise ValueError("no errors")
        sse = float(errors @ errors)
        return Statistics(
            rmse=float(np.sqrt(sse / len(errors))),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            std=float(errors.std()),
            min=float(errors.min()),
            max=float(errors.max()),
            sse=sse,
            count=len(errors),
        )

    def to_dict(self) -> dict[str, float | int]:
        """Plain values by name."""
        return asdict(self)
