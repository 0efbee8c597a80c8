"""Simulate the paper's field test: compare methods on one recording, against the truth and a noisy laser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.benchmarks.provenance import Provenance
from barsight.benchmarks.yard.run_cost import RunCost
from barsight.evaluation.score import Figures, score_folder
from barsight.recording.base import Recording
from barsight.result_folder import read_summary

VARIANTS: dict[str, tuple[str, ...]] = {
    "paper": ("--stereo.method", "paper", "--motion.estimator", "paper", "--map.contours", "paper"),
    "sgbm": ("--stereo.method", "sgbm"),
    "sgbm 5path": ("--stereo.method", "sgbm", "--stereo.sgbm.mode", "5path"),
    "ours": (),
    "ours fast": ("--preset", "fast"),
    "ours crane-only": ("--motion.estimator", "crane"),
    "ours votes-alone": ("--map.own-ratio", "0.01", "--map.along-m", "0"),
    "ours self-calibrated": ("--self-calibrate", "yaw"),
    "ours paper-contours": ("--map.contours", "paper"),
}
"""Flags of `barsight measure`, by method. `sgbm` has our trajectory and fusion and sums its costs along
four paths, `sgbm 5path` along five. The last rows are the ablation: trajectory, fusion (any height that
enough views see, each cell on its own), self-calibration, contours.
"""

_HEADS = ("bias_mm", "mae_mm", "p95_mm", "coverage_pct", "within_95_pct")


@dataclass(frozen=True)
class YardRow:
    """One method. smooth, everywhere: errors of its contours against the truth; heights: of all cells that
    two frames see. laser_mae_mm, laser_smooth_mae_mm: MAE against the noisy laser, mean over the profiles
    (NaN without overlap).
    """

    method: str
    flags: tuple[str, ...]
    smooth: Figures
    everywhere: Figures
    heights: Figures
    laser_mae_mm: float
    laser_smooth_mae_mm: float
    cost: RunCost


@dataclass(frozen=True)
class YardBench:
    """The laser's own error against the truth (mm), and a row per method. what: the recording in words."""

    what: str
    laser_bias_mm: float
    laser_mae_mm: float
    rows: tuple[YardRow, ...]
    provenance: Provenance


def laser_error_mm(recording: Recording, folder: Path) -> tuple[float, float]:
    """Compute bias and MAE of the recording's laser against its truth."""
    with np.load(folder / "truth" / "height.npz") as truth:
        errors = [p.z_m - truth[f"profile_y{p.profile}"] for p in recording.laser()]
    if not errors:
        return float("nan"), float("nan")
    error = 1e3 * np.concatenate(errors)
    return float(error.mean()), float(np.abs(error).mean())


def yard_row(method: str, flags: tuple[str, ...], recording: Path, out: Path, cost: RunCost) -> YardRow:
    """Score a measured folder."""
    content = read_summary(out)
    figures = score_folder(recording, out)
    agreed = content["agreement"]
    return YardRow(
        method,
        flags,
        figures.get("contour, smooth places", {}),
        figures.get("contour, everywhere", {}),
        figures["height, seen by two"],
        _mean([a["mae_mm"] for a in agreed]),
        _mean([a["smooth_mae_mm"] for a in agreed]),
        cost,
    )


def yard_table(bench: YardBench) -> Table:
    """Tabulate as in the paper's Table 4, with the figures that it omits.

    seen, in 95: % of visible places that are measured, % of errors within the stated 95 % interval. all,
    cells, laser: MAE of whole contours, of all cells that two frames see, and against the laser on smooth
    places.
    """
    title = f"{bench.what}; mm against truth on smooth places, commit {bench.provenance.commit}"
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("method", min_width=len("self-calibrated"))
    heads = ("bias", "MAE", "P95", "seen", "in 95", "all", "cells", "laser")
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    laser = (f"{bench.laser_bias_mm:.1f}", f"{bench.laser_mae_mm:.1f}")
    table.add_row("laser", *laser, *[""] * (len(heads) - 2))
    for row in bench.rows:
        cells = [f"{row.smooth[head]:.1f}" if head in row.smooth else "-" for head in _HEADS]
        others = (row.everywhere.get("mae_mm"), row.heights.get("mae_mm"), row.laser_smooth_mae_mm)
        cells += ["-" if value is None else f"{value:.1f}" for value in others]
        table.add_row(row.method, *cells)
    return table


def _mean(values: list[float | None]) -> float:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else float("nan")
