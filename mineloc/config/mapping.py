"""From runs to maps."""

from __future__ import annotations

from mineloc.config.section import Section


class LoopsConfig(Section):
    """Loop closures: candidates, registration, what makes one believed."""


class FusionConfig(Section):
    """Fusion of depth images with LiDAR ranges (METHOD 6.1)."""


class ControlConfig(Section):
    """Surveyed control points: how they are seen and how they enter the graph."""


class MapConfig(Section):
    """The map as a survey product."""
