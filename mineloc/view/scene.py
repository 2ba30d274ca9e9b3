"""A run laid into the frame in which it is drawn: the reference's, or its own map when there is none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc.config import EvaluateConfig
from mineloc.data import F64, Trajectory
from mineloc.stages.comparison import Comparison, compare, frame_of
from mineloc.stages.run_folder import RunFolder


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What there is to see.

    Attributes:
        run: the opened folder.
        T_frame_map: (4, 4) from the run's map to the frame of the scene.
        smoothed, online: `T_frame_body`, each under its own alignment.
        comparisons: by estimate (`online`, `smoothed`), empty without a reference.
    """

    run: RunFolder
    T_frame_map: F64
    smoothed: Trajectory
    online: Trajectory
    comparisons: dict[str, Comparison]

    @staticmethod
    def of(run: RunFolder, config: EvaluateConfig) -> Scene:
        """Compare and align."""
        comparisons = compare(run, config)
        T_frame_map = frame_of(comparisons.get("smoothed"))
        return Scene(
            run=run,
            T_frame_map=T_frame_map,
            smoothed=run.smoothed.compose(left=T_frame_map),
            online=run.online.compose(left=frame_of(comparisons.get("online"))),
            comparisons=comparisons,
        )

    @property
    def lidar(self) -> Trajectory:
        """Pose of the lidar in the scene, smoothed."""
        T_body_lidar = np.asarray(self.run.manifest["calibration"]["T_body_lidar"], dtype=np.float64)
        return self.smoothed.compose(right=T_body_lidar, child="lidar")
