"""Registration ends in the same bits every time, however open3d shares the work out."""

from typing import Any

import numpy as np
import open3d as o3d

from mineloc.mapping.one_thread import one_thread


def test_registration_gives_the_same_bits_every_time() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-5.0, 5.0, (60_000, 3))
    points[:, 2] = np.sin(points[:, 0]) + 0.1 * rng.normal(size=len(points))
    target, source = o3d.geometry.PointCloud(), o3d.geometry.PointCloud()
    target.points = o3d.utility.Vector3dVector(points)
    target.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(10))
    moved = points[::2] + 0.05 * rng.normal(size=(30_000, 3)) + [0.1, 0.05, 0.02]
    source.points = o3d.utility.Vector3dVector(moved)
    pipeline: Any = o3d.pipelines.registration

    def registered() -> bytes:
        with one_thread():
            found = pipeline.registration_icp(
                source,
                target,
                0.5,
                np.eye(4),
                pipeline.TransformationEstimationPointToPlane(pipeline.TukeyLoss(0.3)),
                pipeline.ICPConvergenceCriteria(1e-6, 1e-6, 5),
            )
        return np.asarray(found.transformation).tobytes()

    assert len({registered() for _ in range(4)}) == 1
