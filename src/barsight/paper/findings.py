"""State in a sentence what was measured for each of the paper's conclusions."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.errors import BarsightError
from barsight.paper.cloud import DriftRow
from barsight.paper.features import FilteredMatches

Results = dict[str, dict[str, Any] | BarsightError]


def of_drift(rows: Sequence[DriftRow]) -> str:
    """State how many frames each estimate placed, and its drift."""
    parts = []
    for row in rows:
        drift = f", {row.drift_pct:.2f} % off" if math.isfinite(row.drift_pct) else ""
        parts.append(f"{row.what}: {row.placed} of {row.frames} pairs placed{drift}")
    return "; ".join(parts) + "."


def of_depth(errors_mm: dict[str, float]) -> str:
    """State the median error of each depth."""
    known = [f"{label} {error:.0f} mm" for label, error in errors_mm.items() if math.isfinite(error)]
    if not known:
        return "Nothing: the recording has no true depth."
    return f"Median depth error of one view: {', '.join(known)}."


def of_matches(rows: Sequence[FilteredMatches]) -> str:
    """State how many matches are true at each step, and how many true ones are lost."""
    shares = np.array([[row.true_before, row.true_plane, row.true_after, row.kept_true] for row in rows])
    if not np.isfinite(shares).any():
        return "Nothing: the recording has no truth."
    before, plane, after, kept = np.nanmean(shares, axis=0)
    return (
        f"Of the initial matches {before:.0f} % are true, of those on the homography {plane:.0f} %, of "
        f"those on the trend too {after:.0f} %; {kept:.0f} % of the true ones are left (means of three "
        "detectors, side and top where truth is known)."
    )


def of_results(results: Results) -> str:
    """State each method's rate, and the error of its contours against the truth."""
    parts = []
    for method, result in results.items():
        if isinstance(result, BarsightError):
            parts.append(f"{method}: {result}")
            continue
        mae = result.get("truth", {}).get("contour, smooth places", {}).get("mae_mm", math.nan)
        error = f", {mae:.1f} mm off truth on smooth places" if math.isfinite(mae) else ""
        parts.append(f"{method}: {result['frames']['used'] / result['seconds']:.2f} pairs a second{error}")
    return "; ".join(parts) + ". The paper's 30 Hz is its camera's."


def of_bundles(scratch: Path, results: Results, recording: Path) -> str:
    """State how many bundles each method's map shows, and how many truly lie on top."""
    parts = []
    for method, result in results.items():
        if not isinstance(result, BarsightError):
            content = json.loads((scratch / method / "bundles.json").read_text(encoding="utf-8"))
            parts.append(f"{len(content['bundles'])} bundles in the map by {method}")
    truth = recording / "truth" / "bundles.json"
    if truth.is_file():
        there = json.loads(truth.read_text(encoding="utf-8"))
        parts.append(f"{sum(one['on_top'] for one in there)} lie on top in truth")
    return "; ".join(parts) + "."
