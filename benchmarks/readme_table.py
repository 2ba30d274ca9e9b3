"""Result tables in the project's README, each between two markers of its own."""

from __future__ import annotations

from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def write_readme(name: str, text: str, flown: str) -> None:
    """Put a table, and how it was made, between `<!-- NAME table -->` and `<!-- end of NAME table -->`.

    Raises:
        ValueError: README.md has no such markers.
    """
    start, end = f"<!-- {name} table -->", f"<!-- end of {name} table -->"
    before, found, rest = README.read_text(encoding="utf-8").partition(start)
    _, ended, after = rest.partition(end)
    if not (found and ended):
        raise ValueError(f"{README}: no markers of a table named {name}")
    README.write_text(f"{before}{start}\n{flown}\n\n{text}\n{end}{after}", encoding="utf-8")
