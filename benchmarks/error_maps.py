"""Pictures of paper A's experiment: the error along the flight over the mine, and how alike intersections are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from mineloc.io.intersection_database import read_database
from mineloc.metrics.alignment import Alignment, alignment
from mineloc.stages.run_folder import RunFolder

_COLUMNS = 3


def error_maps(folders: dict[str, Path], out: Path, *, in_map: Sequence[str]) -> None:
    """Position error of the smoothed trajectory along the flight, a panel a method (paper A, figs. 6 to 10).

    Args:
        folders: run folders by method.
        in_map: methods that are judged without alignment; the others with their first pose on the reference's.
    """
    rows = -(-len(folders) // _COLUMNS)
    figure, panels = plt.subplots(rows, _COLUMNS, figsize=(15, 5.2 * rows), dpi=110, squeeze=False)
    for axes in panels.flat[len(folders) :]:
        axes.set_visible(False)
    for axes, (method, folder) in zip(panels.flat, folders.items(), strict=False):
        run = RunFolder.open(folder)
        assert run.reference is not None
        truth = run.reference.at(run.smoothed.stamps_ns)
        kind: Alignment = "none" if method in in_map else "origin"
        laid = alignment(truth, run.smoothed.poses, kind) @ run.smoothed.poses
        error = np.linalg.norm(laid[:, :3, 3] - truth[:, :3, 3], axis=1)
        shown = axes.scatter(truth[:, 0, 3], truth[:, 1, 3], c=error, s=2, cmap="viridis", rasterized=True)
        rmse, most = float(np.sqrt(np.mean(error**2))), float(error.max())
        axes.set(title=f"{method}\nRMSE {rmse:.2f} m, max {most:.2f} m ({kind})", aspect="equal")
        axes.set(xlabel="east (m)", ylabel="north (m)")
        figure.colorbar(shown, ax=axes, label="error (m)", shrink=0.8)
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    plt.close(figure)


def similarity_matrices(database: Path, out: Path) -> None:
    """PWCV and CWC similarity of all intersections (paper A, fig. 16)."""
    known = read_database(database)
    figure, panels = plt.subplots(1, 2, figsize=(14, 6.4), dpi=110)
    names = [one.name for one in known.intersections]
    for axes, (name, matrix) in zip(
        panels, (("PWCV", known.contour_similarity), ("CWC", known.matrix_similarity)), strict=True
    ):
        shown = axes.imshow(matrix, vmin=0, vmax=1, cmap="viridis")
        axes.set(title=f"{name} similarity", xticks=range(len(names)), yticks=range(len(names)))
        axes.set_xticklabels(names, rotation=90, fontsize=5)
        axes.set_yticklabels(names, fontsize=5)
        figure.colorbar(shown, ax=axes, shrink=0.8)
    figure.suptitle(f"{len(names)} intersections; PWCV threshold {known.contour_threshold:.2f}")
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    plt.close(figure)
