"""Named facts about a recording that somebody should know: what was dropped, recovered, assumed or contradicted."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """One kind of thing that was found.

    Attributes:
        name: what, as an identifier: `points_not_finite`.
        count: how often (points, sweeps or messages, as the detail says).
        detail: one line for people, about the first time it was found.
    """

    name: str
    count: int
    detail: str


class FindingCounter:
    """Collects findings by name, keeping the first detail and the sum."""

    def __init__(self) -> None:
        self._found: dict[str, Finding] = {}

    def add(self, name: str, detail: str, *, count: int = 1) -> None:
        """Count one more; nothing happens for `count` 0."""
        if count:
            before = self._found.get(name)
            first, total = (detail, count) if before is None else (before.detail, before.count + count)
            self._found[name] = Finding(name, total, first)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was found so far, in order of first appearance."""
        return tuple(self._found.values())
