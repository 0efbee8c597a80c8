"""Read a live run's health and the positions of crane and magnet from the files that it writes."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.json_values import json_value
from barsight.core.reading.live_run import read_crane_pose, read_live_state, running_folder

STOPPED_S = 10.0
"""Age of health.json from which on the run counts as stopped."""
HISTORY = 720
"""Number of health.json's states that are kept for the trends."""
_FOR_LIFTS = ("full", "no-imu")


@dataclass(frozen=True)
class LiveHealth:
    """A live run's last health.json (None if there is none), its age, and an alarm's code and reason."""

    content: dict[str, Any] | None
    age_s: float | None
    problem: tuple[str, str] | None


class LiveFolder:
    """Reads a live run's folder, and keeps its history for the trends."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.history: deque[dict[str, Any]] = deque(maxlen=HISTORY)

    def look(self) -> LiveHealth:
        """Read health.json; add a new one to the history."""
        path = running_folder(self.folder) / "health.json"
        try:
            changed_s = path.stat().st_mtime
            content = json.loads(path.read_text(encoding="utf-8"))
            mode, rates = content["mode"], dict(content["rates_hz"])
            kept = {
                "at_s": changed_s,
                "mode": mode,
                "rates_hz": rates,
                "backlog": content["queues"]["keyframes"],
            }
        except (OSError, ValueError, KeyError, TypeError):
            return LiveHealth(None, None, ("live-stopped", f"{path}: not there or torn"))
        if not self.history or self.history[-1]["at_s"] != changed_s:
            self.history.append(kept)
        age_s = time.time() - changed_s
        problem = None
        if abs(age_s) > STOPPED_S:  # below 0: the clock has been set back since
            problem = ("live-stopped", str(path))
        elif mode not in _FOR_LIFTS:
            problem = ("live-degraded", str(mode))
        return LiveHealth(content, age_s, problem)

    def crane(self, seen_at: Callable[[tuple[float, float]], int | None]) -> bytes:
        """Return as JSON the run's state, the positions of crane and magnet, and when that place was last
        seen; no position if it is outdated. seen_at: returns the time (ns) at which a place was last seen.
        """
        folder = running_folder(self.folder)
        live = read_live_state(folder)
        if live is None or not live.is_running:
            return json.dumps({"mode": None, "reasons": [], "place": None}).encode()
        pose = read_crane_pose(folder, live.now_ns)
        place = None
        if pose is not None:
            body_m = pose.x_m, pose.y_m
            seen_ns = seen_at(pose.magnet_m or body_m)
            place = {"body_m": body_m, "magnet_m": pose.magnet_m, "map_seen_ns": seen_ns}
        content = {"mode": live.mode, "reasons": live.reasons, "place": place}
        return json.dumps(json_value(content, decimals=3), allow_nan=False).encode()
