"""What of a survey runs again: nothing when nothing changed, and of a change exactly what depends on it.

    .venv/bin/python benchmarks/survey_again.py --work FOLDER [--flights 20]

flies short flights, runs six of them as one survey by `mineloc run --local`, then again, with one more flight, with one
changed configuration field, then all of them, and once more as often as `--repeat` says. Writes
results/survey_again.md.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path

from edgar_map import mineloc

ROOT = Path(__file__).resolve().parents[1]
FIRST = 6
COLUMNS = ("survey", "flights", "stages", "executed", "known", "seconds")


def flown(work: Path, number: int) -> list[str]:
    """Names of short flights, each with a seed of its own."""
    names = [f"flight{k:02d}" for k in range(number)]
    for k, name in enumerate(names):
        if not (work / f"{name}.mcap").exists():
            mineloc("simulate", "demo", "--out", work / f"{name}.mcap", "--length-m", "20", "--seed", str(500 + k))
    return names


class Bench:
    """Runs surveys in one folder, so that each finds what those before it left."""

    def __init__(self, work: Path) -> None:
        self._work = work
        self.rows: list[str] = []

    def run(self, told: str, names: list[str], config: str = "") -> float:
        """Run a survey of flights; wall seconds of the command, the interpreter's start included."""
        lines = ["workers = 2", 'methods = ["odometry"]', *([config] if config else [])]
        for name in names:
            lines += ["[[flight]]", f'name = "{name}"', f'recording = "{name}.mcap"']
        (self._work / "survey.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
        text, seconds, _ = mineloc("run", self._work / "survey.toml", "--local", "--out", self._work / "results")
        executed, known = text.count("✓"), text.count(" known")
        cells = [told, str(len(names)), str(executed + known), str(executed), str(known), f"{seconds:.1f}"]
        self.rows.append("| " + " | ".join(cells) + " |")
        print(self.rows[-1], flush=True)
        return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for flights and results (2 GB)")
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "survey_again.md")
    chosen = parser.parse_args()
    work = chosen.work.absolute()
    work.mkdir(parents=True, exist_ok=True)
    names = flown(work, chosen.flights)
    bench = Bench(work)
    bench.run("new", names[:FIRST])
    bench.run("again", names[:FIRST])
    bench.run("and a new flight", names[: FIRST + 1])
    bench.run("a field of the Rerun recordings changed", names[: FIRST + 1], "[config.view]\nsweep_stride = 6")
    bench.run("a field of the odometry changed", names[: FIRST + 1], "[config.odometry]\nmax_flatness = 0.06")
    bench.run("all flights", names)
    again = [bench.run("again", names) for _ in range(chosen.repeat)]
    text = "\n".join(["| " + " | ".join(COLUMNS) + " |", "| --- " + "| ---: " * (len(COLUMNS) - 1) + "|", *bench.rows])
    head = (
        f"`python benchmarks/survey_again.py --flights {chosen.flights}`: {chosen.flights} flights of 20 m of the demo "
        f"mine by odometry, two workers. The whole survey, unchanged: median {statistics.median(again):.2f} s of "
        f"{chosen.repeat}, the start of the interpreter and the hashes of all sources of the program included."
    )
    chosen.out.write_text(f"# What of a survey runs again\n\n{head}\n\n{text}\n")


if __name__ == "__main__":
    main()
