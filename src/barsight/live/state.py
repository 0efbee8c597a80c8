"""Write a run's state and health for readers: state.json, health.json and health.prom."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from barsight.core.files import atomic_path
from barsight.core.json_values import write_json
from barsight.core.memory import resident_bytes
from barsight.live.drift import DRIFT_FILE, drift_figures
from barsight.live.latency import counts
from barsight.live.modes import MODES, Mode
from barsight.live.shared.counters import Counters


@dataclass
class ProcessState:
    """A process of the run. state: `starting`, `running`, `restarting`, `done`. reason: why it last ended."""

    pid: int = 0
    state: str = "starting"
    restarts: int = 0
    reason: str = ""


@dataclass
class RunState:
    """Content of state.json. phase: `starting`, `measuring`, `finishing`, `done` or `failed`.

    now_ns: on the cameras' clock. lifts_until: why lifts aren't valid, empty if they are.
    """

    phase: str = "starting"
    now_ns: int = 0
    mode: Mode = field(default_factory=lambda: Mode("blind", ("starting",), False))
    processes: dict[str, ProcessState] = field(default_factory=dict)
    offered: int | None = None

    def content(self, board: Counters) -> dict[str, Any]:
        """Build the content of state.json."""
        may_stand = self.mode.lifts and self.phase != "failed"
        return {
            "schema_version": 1,
            "phase": self.phase,
            "pid": os.getpid(),
            "now_ns": self.now_ns,
            "mode": self.mode.name,
            "reasons": list(self.mode.reasons),
            "lifts": {"may_stand": may_stand, "offered": self.offered if may_stand else 0},
            "processes": {name: vars(process).copy() for name, process in self.processes.items()},
            "backlog_keyframes": board["map", "backlog"],
            "frames": counts(board),
        }


def write_state(state: RunState, board: Counters, out: Path) -> None:
    """Write state.json."""
    write_json(out / "state.json", state.content(board))


def write_health(state: RunState, board: Counters, seconds: float, out: Path) -> None:
    """Write health.json and health.prom, Prometheus' text for a file collector. seconds: since the start."""
    frames = counts(board)
    free = shutil.disk_usage(out).free
    memory = {name: resident_bytes(process.pid) for name, process in state.processes.items()}
    content = {
        "schema_version": 1,
        "seconds": round(seconds, 3),
        "mode": state.mode.name,
        "lifts_may_stand": state.mode.lifts,
        "rates_hz": {
            name: round(frames[name] / seconds, 3) if seconds > 0 else 0.0
            for name in ("captured", "paired", "tracked", "kept", "mapped")
        },
        "frames": frames,
        "queues": {"keyframes": board["map", "backlog"]},
        "restarts": {name: process.restarts for name, process in state.processes.items()},
        "memory_bytes": memory | {"supervisor": resident_bytes()},
        "disk_free_bytes": free,
        "disk_days": _disk_days(free, board["record", "bytes"], seconds),
        "sensors": board.row("sensors")
        | {name: board["capture", name] for name in ("skew_ns", "max_skew_ns")},
        "record": board.row("record"),
        "calibration": drift_figures(out.parent / DRIFT_FILE),
    }
    write_json(out / "health.json", content)
    with atomic_path(out / "health.prom") as path:
        path.write_text(prometheus(content), encoding="utf-8")


def prometheus(health: Mapping[str, Any]) -> str:
    """Write health in Prometheus' text format, one metric per line."""
    frames = dict(health["frames"])
    dropped = frames.pop("dropped")
    metrics = {
        "barsight_frames_total": ("counter", "stage", frames),
        "barsight_frames_dropped_total": ("counter", "cause", dropped),
        "barsight_restarts_total": ("counter", "process", health["restarts"]),
        "barsight_queue_length": ("gauge", "queue", health["queues"]),
        "barsight_memory_bytes": ("gauge", "process", health["memory_bytes"]),
        "barsight_sensor": ("gauge", "sign", health["sensors"]),
        "barsight_recorder": ("gauge", "sign", health["record"]),
        "barsight_calibration": ("gauge", "figure", health["calibration"]),
        "barsight_mode": ("gauge", "mode", {mode: int(mode == health["mode"]) for mode in MODES}),
    }
    lines = []
    for name, (kind, label, values) in metrics.items():
        lines.append(f"# TYPE {name} {kind}")
        lines += [f'{name}{{{label}="{key}"}} {value}' for key, value in values.items()]
    lines += [
        "# TYPE barsight_disk_free_bytes gauge",
        f"barsight_disk_free_bytes {health['disk_free_bytes']}",
        "# TYPE barsight_lifts_may_stand gauge",
        f"barsight_lifts_may_stand {int(health['lifts_may_stand'])}",
    ]
    if health["disk_days"] is not None:
        lines += ["# TYPE barsight_disk_days gauge", f"barsight_disk_days {health['disk_days']}"]
    return "\n".join(lines) + "\n"


def _disk_days(free_bytes: int, recorded_bytes: int, seconds: float) -> float | None:
    """Compute how many days the free disk space lasts at the rate so far; None if nothing is recorded."""
    if recorded_bytes <= 0 or seconds <= 0:
        return None
    return round(free_bytes / (recorded_bytes / seconds) / 86400, 2)
