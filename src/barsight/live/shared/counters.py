"""Count in shared memory: each process writes its own row, so that no lock can be left held."""

from __future__ import annotations

import time
from multiprocessing.shared_memory import SharedMemory

import numpy as np

from barsight.core.arrays import Int64

OFF = ("bridge_off_um", "trolley_off_um", "hoist_off_um")
"""Counters of `track`: by how much each encoder has jumped by now."""
ROWS: dict[str, tuple[str, ...]] = {
    "supervisor": ("began_ns", "stop", "alarms"),
    "capture": (
        "ready", "ended", "pictures_cam0", "pictures_cam1", "paired", "unpaired_cam0", "unpaired_cam1",
        "torn", "capture_down", "incomplete", "missed", "backpressure", "late", "clock", "trigger", "skew_ns",
        "max_skew_ns", "last_cam0_ns", "last_cam1_ns", "last_pair_ns", "interval_ns", "first_ns",
        "beat_ns",
    ),
    "track": (
        "ready", "done", "taken", "tracked", "not_placed", "newer_pair", "kept", "kept_passed", "beat_ns",
        *OFF,
    ),
    "pose": ("ready", "written", "beat_ns"),
    "sensors": (
        "cam0_settled", "cam0_drift_ppb", "cam0_jitter_ns", "cam0_jumps", "cam0_lost", "cam0_connects",
        "cam1_settled", "cam1_drift_ppb", "cam1_jitter_ns", "cam1_jumps", "cam1_lost", "cam1_connects",
        "cam0_ptp", "cam1_ptp",
        "imu_settled", "imu_drift_ppb", "imu_jitter_ns", "imu_jumps", "imu_lost", "imu_torn",
        "imu_overtaken", "imu_restarts",
        "crane_settled", "crane_drift_ppb", "crane_jitter_ns", "crane_jumps", "crane_lost", "crane_torn",
        "crane_overtaken", "crane_restarts", "one_clock",
    ),
    "record": ("ready", "pairs", "readings", "deleted", "paused", "alarms", "backlog", "bytes", "beat_ns"),
    "map": ("ready", "mapped", "refused", "backlog", "snapshots", "beat_ns"),
}  # fmt: skip
"""Counters of each process; those of `sensors` are also capture's. Those in _ns are stamps or durations;
began_ns and beat_ns, the time of a process's last loop, are on the monotonic clock.
"""
DRAIN = 2
"""Value of `stop` when capture and tracking have ended and only the remaining work is to be done."""
_WIDTH = max(len(names) for names in ROWS.values())


class Counters:
    """Counters in shared memory: `board["track", "taken"]`. A process writes only its own row.

    name: of an existing board; without it a new one is made, whose maker unlinks it by `remove`.
    """

    def __init__(self, name: str | None = None) -> None:
        size = len(ROWS) * _WIDTH * 8
        self._memory = SharedMemory(name, create=name is None, size=size)
        self.name = self._memory.name
        self._rows = {role: k for k, role in enumerate(ROWS)}
        self._cells: Int64 = np.ndarray((len(ROWS), _WIDTH), np.int64, self._memory.buf)
        if name is None:
            self._cells[:] = 0

    def __getitem__(self, key: tuple[str, str]) -> int:
        return int(self._cells[self._place(key)])

    def __setitem__(self, key: tuple[str, str], value: int) -> None:
        self._cells[self._place(key)] = value

    def add(self, role: str, name: str, count: int = 1) -> None:
        """Add to a counter of the caller's own row."""
        self[role, name] += count

    def beat(self, role: str) -> None:
        """Record the heartbeat of a process."""
        self[role, "beat_ns"] = time.monotonic_ns()

    def row(self, role: str) -> dict[str, int]:
        """Return all counters of a process."""
        return {name: self[role, name] for name in ROWS[role]}

    def remove(self) -> None:
        """Unlink the memory; only its maker may call this."""
        self.close()
        self._memory.unlink()

    def close(self) -> None:
        """Detach from the memory."""
        self._cells = np.empty((0, 0), np.int64)
        self._memory.close()

    def _place(self, key: tuple[str, str]) -> tuple[int, int]:
        role, name = key
        return self._rows[role], ROWS[role].index(name)
