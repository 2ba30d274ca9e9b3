"""What every front end can do."""

from __future__ import annotations

from typing import Protocol

from mineloc.data import ImuSamples, OdometryStep, Sweep


class FrontEnd(Protocol):
    """Turns sweeps into poses, one after the other."""

    def step(self, sweep: Sweep, imu: ImuSamples) -> OdometryStep:
        """Take the next sweep and the inertial samples that arrived since the one before.

        Args:
            sweep: range-filtered points, in the order of firing.
            imu: samples after the previous call's up to the sweep's end (a few more or less do no harm); may be empty.

        Raises:
            FlightError: time goes backwards.
        """
        ...
