"""Run `barsight live --config crane.toml`: measure from the crane's own sensors until a signal comes."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from barsight.core.files import expect_empty, translated_os_errors
from barsight.live.crane.preflight import prove_sensors
from barsight.live.run import LiveRun
from barsight.live.settings import CraneConfig, LiveSettings
from barsight.map_building import ProgressCallback
from barsight.measure_folder import ignore_progress
from barsight.measure_settings import MeasureSettings
from barsight.recording.writers.bag import write_descriptions
from barsight.yard.magnet.description import load_magnet


def measure_crane(
    crane: CraneConfig, out: Path, settings: MeasureSettings, live: LiveSettings, *,
    magnet: Path | None = None, tell: Callable[[str], None] = print,
    advance: ProgressCallback = ignore_progress,
) -> dict[str, Any]:  # fmt: skip
    """Measure what a crane's sensors give into `out` until Ctrl-C or SIGTERM; return what result.json says.

    All sensors are proved first; nothing is written where one of them isn't as crane.toml says.
    Raises a BarsightError.
    """
    described = None if magnet is None else load_magnet(magnet)
    expect_empty(out)
    folder = out.absolute() / "recording"
    if crane.recorder.folder is not None:
        folder = crane.recorder.folder / datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
    awaited = crane.described(folder)
    prove_sensors(crane, awaited)
    with translated_os_errors(folder):
        out.mkdir(parents=True, exist_ok=True)
        folder.mkdir(parents=True)
        write_descriptions(awaited, folder)
    epoch_ns = time.time_ns() - time.monotonic_ns()
    run = LiveRun(crane.awaited(folder), folder, out, settings, live, 1.0, tell, crane, epoch_ns)
    return run.measure(None, described, "now", advance)
