"""Read the state of a live run from its folder: state.json, health.json and pose.json."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from barsight.core.errors import BarsightError
from barsight.core.reading.bounded_reading import read_json

MAX_SILENCE_S = 1.0
"""Maximum age of state.json of a run that is alive; it is written ten times a second."""
_TORN = (BarsightError, OSError, KeyError, TypeError, ValueError)


@dataclass(frozen=True)
class CranePose:
    """The crane's pose in the yard frame.

    sigma_m: standard deviations. stamp_ns: time of the measurement. magnet_m: x and y of the point that the
    encoders read, below which the magnet hangs; None if unknown.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float | None
    sigma_m: tuple[float, float, float]
    stamp_ns: int
    magnet_m: tuple[float, float] | None = None


@dataclass(frozen=True)
class LiveState:
    """A run's last state.json.

    silent_s: time since it was written; negative if the system's clock was set back since. now_ns: the run's
    clock. may_stand: whether lifts may stay offered.
    """

    phase: str
    mode: str
    reasons: tuple[str, ...]
    may_stand: bool
    now_ns: int
    silent_s: float

    @property
    def is_running(self) -> bool:
        """Check that a running command wrote it recently."""
        return abs(self.silent_s) <= MAX_SILENCE_S and self.phase not in ("done", "failed")


def running_folder(folder: Path) -> Path:
    """Return the folder of the current survey: for a crane's surveys, the link `current`."""
    return folder / "current" if (folder / "current").is_dir() else folder


def read_live_state(folder: Path) -> LiveState | None:
    """Read a run's state.json; None if it is missing or damaged."""
    path = folder / "state.json"
    try:
        told = read_json(path)
        silent_s = time.time() - path.stat().st_mtime
        reasons = tuple(str(one) for one in told["reasons"])
        may_stand, now_ns = bool(told["lifts"]["may_stand"]), int(told["now_ns"])
        return LiveState(str(told["phase"]), str(told["mode"]), reasons, may_stand, now_ns, silent_s)
    except _TORN:
        return None


def read_crane_pose(folder: Path, now_ns: int) -> CranePose | None:
    """Read the latest pose; None if it is too old or not in the yard frame. It may be newer than now_ns."""
    try:
        told: dict[str, Any] = read_json(folder / "pose.json")
        stamp_ns = int(told["stamp_ns"])
        x_m, y_m, z_m = (float(value) for value in told["position_m"])
        sx_m, sy_m, sz_m = (float(value) for value in told["sigma_m"])
        turn = Rotation.from_quat([float(value) for value in told["quaternion_xyzw"]]).as_matrix()
        crane_m = told.get("crane_m")
        magnet_m = None if crane_m is None else (float(crane_m[0]), float(crane_m[1]))
    except (*_TORN, IndexError):
        return None
    if told.get("frame") != "yard" or abs(now_ns - stamp_ns) > MAX_SILENCE_S * 1e9:
        return None
    if not all(map(math.isfinite, (x_m, y_m, z_m, sx_m, sy_m, sz_m, *(magnet_m or ())))):
        return None
    yaw_deg = math.degrees(math.atan2(turn[1, 0], turn[0, 0]))
    return CranePose(x_m, y_m, z_m, yaw_deg, (sx_m, sy_m, sz_m), stamp_ns, magnet_m)
