"""Find the floor area that a measured yard shows, and the height it was seen from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from barsight.acceptance.layout import Area
from barsight.acceptance.observation import view_geometry
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.errors import InputError
from barsight.core.records.heights import HeightSource
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from barsight.result_folder import open_folder, read_heights

MARGIN_M = 0.3
SHARE = 0.6
"""Minimum number of seen cells in a row or column of the map, as a fraction of the best one, for it to
count.
"""


def measured_area(folder: Path) -> Area:
    """Find the area of a measured folder whose recording still exists. Raises InputError."""
    summary, _ = open_folder(folder, lifts=False)
    if summary["reference"] != "yard":
        raise InputError(folder, "isn't in the yard's frame", "measure with encoders, or with --yard")
    view = view_geometry(folder, measured_rig(summary))
    heights = read_heights(folder)
    part = heights.part(slice(0, heights.shape[0]), slice(0, heights.shape[1]))
    seen = part.source == HeightSource.VISION
    spans = []
    for along, places in ((seen.sum(axis=0), part.x_m), (seen.sum(axis=1), part.y_m)):
        wide = np.flatnonzero(along >= SHARE * along.max())
        spans.append((float(places[wide[0]]) + MARGIN_M, float(places[wide[-1]]) - MARGIN_M))
    if min(high - low for low, high in spans) < 1.0:
        raise InputError(folder, "shows too little of a yard for artefacts", "travel over more floor")
    return Area(spans[0], spans[1], float(view.camera_m[2]), view.focal_px, view.baseline_m)


def measured_rig(summary: dict[str, Any]) -> StereoRig:
    """Read the rig with which a folder was measured; its recording must still exist."""
    recording = Path((summary.get("recording") or {}).get("path") or "")
    return open_recording(recording, RecordingSettings(rig=_rig_file(summary))).rig


def _rig_file(summary: dict[str, Any]) -> Path | None:
    """Return the rig file with which the folder was measured, None for the recording's own rig."""
    configuration = summary.get("configuration")
    reading = configuration.get("recording") if isinstance(configuration, dict) else None
    file = reading.get("rig") if isinstance(reading, dict) else None
    return Path(str(file)) if file else None
