"""What a plan must know of methods, without loading what they need."""

from __future__ import annotations

KNOW_A_MAP = frozenset({"map_tracking", "intersections_map"})
"""Methods that localize in a prior map; all others use none."""
