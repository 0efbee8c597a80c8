"""Time the front end (`bench front-end`): reading, decoding, rectifying and tracking pairs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from barsight.benchmarks.provenance import Provenance, Timing, provenance, summarise_times
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.records.pairs import RefusedFrame
from barsight.motion.frontend.motion_prediction import CranePredictor
from barsight.motion.frontend.settings import FrontEndSettings
from barsight.motion.frontend.sightings import Sighting
from barsight.motion.frontend.tracking import Predictor, Tracker
from barsight.recording.base import Recording
from barsight.recording.open import open_recording
from barsight.recording.rectified_pairs import RectifiedPairs


@dataclass(frozen=True)
class FrontEndRow:
    """One recording, with motion predicted from encoders and gyro or from images alone.

    points: mean number of points per pair. time: wall ms per pair. cpu_ms: ms per pair, all threads.
    """

    recording: str
    size: tuple[int, int]
    predicted_by: str
    pairs: int
    refused: int
    points: float
    time: Timing
    cpu_ms: float


@dataclass(frozen=True)
class FrontEndBench:
    """The rows, and the machine and commit that they were measured with."""

    made: Provenance
    rows: tuple[FrontEndRow, ...]


def bench_front_end(paths: tuple[Path, ...], repeats: int = 3) -> FrontEndBench:
    """Time each whole recording, `repeats` times after a warm-up run that compiles."""
    rows = []
    for path in paths:
        recording = open_recording(path)
        predictors: dict[str, Predictor] = {"pictures": lambda old, new: None}
        crane, imu = recording.crane(), recording.imu()
        if crane is not None and imu is not None:
            bias, shift = imu.gyro_radps.mean(axis=0), recording.rig.timeshift_cam_imu_ns
            rectifier = Rectifier(recording.rig)
            predictors = {
                "encoders, gyro": CranePredictor(crane, imu, bias, rectifier, shift), **predictors
            }  # fmt: skip
        rows += [_row(recording, name, predictor, repeats) for name, predictor in predictors.items()]
    return FrontEndBench(provenance(), tuple(rows))


def _row(recording: Recording, name: str, predictor: Predictor, repeats: int) -> FrontEndRow:
    rectifier = Rectifier(recording.rig)
    pairs = max(1, len(recording.index.stamps_ns))
    walls, cpus = [], []
    for _ in range(repeats + 1):
        wall, cpu = time.perf_counter(), time.process_time()
        tracker = Tracker(predictor, FrontEndSettings())
        tracked = [
            pair if isinstance(pair, RefusedFrame) else tracker.push(pair)
            for pair in RectifiedPairs(recording, rectifier)()
        ]
        walls.append((time.perf_counter() - wall) / pairs)
        cpus.append((time.process_time() - cpu) / pairs)
    camera = rectifier.camera
    seen = [one for one in tracked if isinstance(one, Sighting)]
    points = float(np.mean([len(s.track) for s in seen])) if seen else 0.0
    refused = len(tracked) - len(seen)
    return FrontEndRow(
        recording.path.resolve().name, (camera.width, camera.height), name, pairs, refused, points,
        summarise_times(walls[1:]), 1e3 * float(np.median(cpus[1:])),
    )  # fmt: skip


def front_end_table(bench: FrontEndBench) -> Table:
    """Tabulate the results for the terminal."""
    table = Table(title=f"Front end on {bench.made.cores} cores ({bench.made.machine})", title_justify="left")
    for column in ("recording", "size", "predicted by", "pairs", "points", "ms a pair", "CPU ms", "pairs/s"):
        table.add_column(column)
    for row in bench.rows:
        t = row.time
        table.add_row(
            row.recording, f"{row.size[0]}x{row.size[1]}", row.predicted_by,
            f"{row.pairs}" + (f" ({row.refused} refused)" if row.refused else ""), f"{row.points:.0f}",
            f"{t.median_ms:.0f} ({t.fastest_ms:.0f}-{t.slowest_ms:.0f})", f"{row.cpu_ms:.0f}",
            f"{1e3 / t.median_ms:.1f}",
        )  # fmt: skip
    return table
