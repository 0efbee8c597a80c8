"""Read what a live run says of itself: whether lifts may stand, and where the crane is."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from barsight.core.errors import BarsightError
from barsight.core.reading.bounded_reading import read_json
from barsight.plant.state import CranePose, PlantState

MAX_SILENCE_S = 1.0
"""A live run writes state.json ten times a second."""


def with_live_run(state: PlantState, folder: Path) -> PlantState:
    """Add the crane's pose, the run's mode and its survey to a state; one without a run is not valid."""
    folder = folder / "current" if (folder / "current").is_dir() else folder
    try:
        told = read_json(folder / "state.json")
        silent_s = time.time() - (folder / "state.json").stat().st_mtime
        phase, mode, reasons = str(told["phase"]), str(told["mode"]), [str(one) for one in told["reasons"]]
        may_stand, now_ns = bool(told["lifts"]["may_stand"]), int(told["now_ns"])
    except (BarsightError, OSError, KeyError, TypeError, ValueError):
        return _forbidden(state, f"live-stopped: {folder / 'state.json'} is not there or torn")
    if silent_s > MAX_SILENCE_S or phase in ("done", "failed"):
        return _forbidden(
            state, f"live-stopped: the live run says nothing for {silent_s:.1f} s, phase {phase}"
        )
    state = replace(state, mode=mode, survey=phase, pose=_pose(folder / "pose.json", now_ns))
    return state if may_stand else _forbidden(state, f"live-state: {mode}: {'; '.join(reasons)}")


def _forbidden(state: PlantState, reason: str) -> PlantState:
    return replace(state, is_valid=False, reasons=(*state.reasons, reason))


def _pose(path: Path, now_ns: int) -> CranePose | None:
    """Read the latest pose; None where it is old, or not in the yard. It may be newer than now_ns."""
    try:
        told: dict[str, Any] = read_json(path)
        stamp_ns = int(told["stamp_ns"])
        x_m, y_m, z_m = (float(value) for value in told["position_m"])
        sx_m, sy_m, sz_m = (float(value) for value in told["sigma_m"])
        turn = Rotation.from_quat([float(value) for value in told["quaternion_xyzw"]]).as_matrix()
    except (BarsightError, OSError, KeyError, TypeError, ValueError):
        return None
    if told.get("frame") != "yard" or abs(now_ns - stamp_ns) > MAX_SILENCE_S * 1e9:
        return None
    if not all(map(math.isfinite, (x_m, y_m, z_m, sx_m, sy_m, sz_m))):
        return None
    yaw_deg = math.degrees(math.atan2(turn[1, 0], turn[0, 0]))
    return CranePose(x_m, y_m, z_m, yaw_deg, (sx_m, sy_m, sz_m), stamp_ns)
