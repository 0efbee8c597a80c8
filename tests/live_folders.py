"""Folders of live runs as `barsight live` writes them."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def live_folder(folder: Path, **changes: object) -> Path:
    folder.mkdir(exist_ok=True)
    lifts = {"may_stand": changes.pop("may_stand", True), "offered": None}
    state = {"phase": "measuring", "mode": "full", "reasons": [], "now_ns": 10_000_000_000, "lifts": lifts}
    pose = {
        "stamp_ns": 9_800_000_000, "frame": "yard", "position_m": [3.0, 1.0, 8.0],
        "quaternion_xyzw": [0.0, 0.0, 0.7071067811865476, 0.7071067811865476], "sigma_m": [0.001] * 3,
        "crane_m": None,
    }  # fmt: skip
    for name, content in (("state.json", state), ("pose.json", pose)):
        content |= {key: value for key, value in changes.items() if key in content}
        (folder / name).write_text(json.dumps(content))
    return folder


@contextmanager
def beating(folder: Path) -> Iterator[None]:
    """A run goes on: its state.json is written again and again."""
    over = threading.Event()

    def beat() -> None:
        while not over.wait(0.1):
            os.utime(folder / "state.json")

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
