"""LinK3D keypoints and Scan Context: paper B's additions to LOAM (METHOD part 2, 4.2, 4.3)."""

from __future__ import annotations

from mineloc.config.section import Section


class Link3dConfig(Section):
    """LinK3D keypoints, descriptors and matching."""


class ScanContextConfig(Section):
    """Scan Context descriptors and their search."""
