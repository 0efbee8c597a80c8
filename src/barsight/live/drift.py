"""Monitor the calibration in service: the right camera's drift from each survey's rows, and its trend."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.stamps import NS_PER_S
from barsight.motion.rig_check.epipolar_error import measure_row_drift
from barsight.recording.base import Recording

DRIFT_FILE = "drift.csv"
HEAD = "stamp_ns,pitch_rad,pitch_sigma,roll_rad,roll_sigma,focal_ratio,focal_ratio_sigma\n"
NAMES = ("pitch_rad", "roll_rad", "focal_ratio")
FRAMES = 8
TREND_SURVEYS, MIN_SURVEYS = 200, 5
DAY_NS = 86400 * NS_PER_S


def note_drift(recording: Recording, path: Path) -> str:
    """Append a survey's drift to drift.csv; return why there is none, or an empty string."""
    found = measure_row_drift(recording, Rectifier(recording.rig), FRAMES)
    if isinstance(found, Failed):
        return found.reason
    figures = np.column_stack([found.values[:3], found.sigmas[:3]]).ravel()
    line = ",".join([str(recording.index.stamps_ns[-1]), *(f"{one:.4g}" for one in figures)])
    with path.open("a", encoding="ascii") as file:
        if not file.tell():
            file.write(HEAD)
        file.write(line + "\n")
    return ""


def drift_figures(path: Path) -> dict[str, float]:
    """Read the last survey's drift and, from `MIN_SURVEYS` on, its growth per day; empty without surveys."""
    known = _read(path)
    figures: dict[str, float] = {}
    for k, name in enumerate(NAMES if len(known) else ()):
        figures |= {name: float(known[-1, 1 + 2 * k]), f"{name}_sigma": float(known[-1, 2 + 2 * k])}
        if len(known) >= MIN_SURVEYS:
            figures[f"{name}_per_day"] = _slope(known[:, 0], known[:, 1 + 2 * k])
    return figures


def _read(path: Path) -> Float64:
    """Read the last surveys of drift.csv, one per row, stamps in days; an incomplete last line is ignored."""
    lines = path.read_text(encoding="ascii").split("\n")[1:-1] if path.is_file() else []
    rows = [line.split(",") for line in lines[-TREND_SURVEYS:] if line.count(",") == HEAD.count(",")]
    return np.array([(int(row[0]) / DAY_NS, *map(float, row[1:])) for row in rows]).reshape(len(rows), 7)


def _slope(days: Float64, values: Float64) -> float:
    """Compute the median slope over all pairs (Theil-Sen), which is robust to single surveys."""
    first, second = np.triu_indices(len(days), 1)
    apart = days[second] - days[first]
    slopes = (values[second] - values[first])[apart > 0] / apart[apart > 0]
    return float(np.median(slopes)) if slopes.size else 0.0
