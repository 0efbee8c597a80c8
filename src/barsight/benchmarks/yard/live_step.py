"""Time a live step (`bench live-step`), from the arrival of a pair to its entry into the map."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.benchmarks.provenance import Provenance, provenance
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64, Int64
from barsight.core.compiling.ahead import compile_ahead
from barsight.core.errors import MeasurementError
from barsight.core.memory import peak_memory_mib
from barsight.core.records.pairs import RefusedFrame
from barsight.core.timing import Stopwatch
from barsight.measure_settings import MeasureSettings
from barsight.motion.settings import make_estimator
from barsight.reconstruction.live_map import LiveMap, PairPlacer
from barsight.reconstruction.tracked_recording import matching
from barsight.recording.base import Recording
from barsight.recording.open import open_recording
from barsight.recording.rectified_pairs import RectifiedPairs

_WARMING_PAIRS = 3
"""Number of untimed warm-up pairs; the third is the first matched by a prediction."""


@dataclass(frozen=True)
class StepTime:
    """A step or a part of it: wall ms and CPU ms of all threads per pair, median and 95th percentile."""

    part: str
    wall_ms: float
    wall_p95_ms: float
    cpu_ms: float
    cpu_p95_ms: float


@dataclass(frozen=True)
class LiveStepBench:
    """A recording's steps that added a pair to the map. first_s: time of the first step, not among them.

    fused: pairs in the map. others: steps besides the first that added none, not counted. parts: the CPU time
    of stereo is NaN, as it isn't measured separately.
    """

    recording: str
    size: tuple[int, int]
    preset: str
    pairs: int
    fused: int
    others: int
    first_s: float
    parts: tuple[StepTime, ...]
    peak_memory_mib: float
    provenance: Provenance


def bench_live_step(path: Path, settings: MeasureSettings) -> LiveStepBench:
    """Time each pair of a recording, in sequence and without matching ahead, after warm-up pairs that load
    all kernels. settings: with the estimator `live`.
    """
    compile_ahead(lambda stage, done, total: None, "measure")
    recording, chosen = open_recording(path, settings.recording), settings.chosen()
    with tempfile.TemporaryDirectory() as scratch:
        _steps(recording, chosen, Path(scratch) / "warming", _WARMING_PAIRS)
        times, fused = _steps(recording, chosen, Path(scratch) / "timed", None)
    grown = np.diff(fused, prepend=0) > 0
    if not grown[1:].any():
        raise MeasurementError(f"{path}: no pair comes into the map")
    rectified, added, elected = times[1:][grown[1:]].transpose(1, 0, 2)
    step = rectified + added
    stereo = np.column_stack([step[:, 2], np.full(len(step), np.nan)])
    parts = (
        _part("step", step[:, :2]),
        _part("rectified", rectified[:, :2]),
        _part("placed, matched, fused", added[:, :2]),
        _part("  of that stereo", stereo),
        _part("surface elected, besides", elected[:, :2]),
    )
    camera = Rectifier(recording.rig).camera
    return LiveStepBench(
        path.resolve().name, (camera.width, camera.height), settings.preset, len(times), int(fused[-1]),
        int((~grown[1:]).sum()), float(times[0, :2, 0].sum()), parts, peak_memory_mib(), provenance(),
    )  # fmt: skip


def live_step_table(bench: LiveStepBench) -> Table:
    """Tabulate the results for the terminal."""
    width, height = bench.size
    table = Table(
        title=f"{bench.recording}: {bench.pairs} pairs of {width}x{height}, {bench.fused} in the map, preset "
        f"{bench.preset}; {bench.provenance.cores} cores",
        caption=f"A pair in, the one before fused, one after the other. Not counted: the first step, which "
        f"took {bench.first_s:.1f} s, and {bench.others} others in which no pair came into the map. The "
        "surface is elected after each pair; `live` does so every 5 s. "
        f"Peak {bench.peak_memory_mib:.0f} MiB",
        box=SIMPLE_HEAD,
    )
    table.add_column("")
    for head in ("ms", "P95", "CPU ms", "P95"):
        table.add_column(head, justify="right")
    for part in bench.parts:
        values = (part.wall_ms, part.wall_p95_ms, part.cpu_ms, part.cpu_p95_ms)
        table.add_row(part.part, *("" if np.isnan(value) else f"{value:.0f}" for value in values))
    return table


def _steps(
    recording: Recording, settings: MeasureSettings, folder: Path, count: int | None
) -> tuple[Float64, Int64]:
    """Map the first `count` pairs into `folder`. Returns times (n, 3, 3), s: wall, CPU and wall in stereo,
    each for rectifying, adding and surface election; and the number of pairs in the map after each step
    (n,).
    """
    folder.mkdir()
    watch = Stopwatch()
    pairs = RectifiedPairs(recording, Rectifier(recording.rig), folder)
    placer = PairPlacer(pairs, make_estimator(settings.motion), None)
    live = LiveMap(pairs, settings, folder, None, placer, matching(pairs, settings, None, watch))
    times, fused = [], []
    for frame in islice(recording.frames(), count):
        marks = [_now(watch)]
        pair = frame if isinstance(frame, RefusedFrame) else pairs.rectify(frame)
        marks.append(_now(watch))
        live.add(pair)
        marks.append(_now(watch))
        live.snapshot(live)
        marks.append(_now(watch))
        times.append(np.diff(marks, axis=0))
        fused.append(len(live.stamps_ns))
    return np.array(times), np.array(fused, dtype=np.int64)


def _now(watch: Stopwatch) -> tuple[float, float, float]:
    stereo_s = sum(seconds for stage, seconds, _ in watch.entries() if stage == "stereo")
    return time.perf_counter(), time.process_time(), stereo_s


def _part(name: str, seconds: Float64) -> StepTime:
    """Summarise times (n, 2), wall and CPU s."""
    (wall, cpu), (wall_p95, cpu_p95) = 1e3 * np.percentile(seconds, (50, 95), axis=0)
    return StepTime(name, float(wall), float(wall_p95), float(cpu), float(cpu_p95))
