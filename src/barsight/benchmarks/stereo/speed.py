"""Time every method on 1280x1024 with 96 candidates, and on a recording's pairs as they are matched for a
map (`bench stereo-speed`), against OpenCV's 5-path SGBM.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.benchmarks.provenance import MIN_REPEATS, Provenance, Timing, provenance, summarise_times
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float32, Float64, UInt8
from barsight.core.errors import InputError, MeasurementError
from barsight.core.records.disparity import DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.core.timing import Stopwatch
from barsight.measure_settings import MeasureSettings
from barsight.reconstruction.tracked_recording import matching
from barsight.recording.open import open_recording
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.stereo.image_pair import pair_from_images
from barsight.stereo.method import StereoMethod
from barsight.stereo.search_range import find_disparity_range

WIDTH_PX, HEIGHT_PX, CANDIDATES = 1280, 1024, 96


@dataclass(frozen=True)
class SpeedResult:
    """One method. ratio: its wall time over that of OpenCV's 5-path SGBM, median of the rounds. cpu_ratio:
    the same for the CPU time of all cores, which other programs on the machine don't affect.
    median_error_px: median absolute error where there is a disparity; NaN on a recording.
    """

    method: str
    time: Timing
    ratio: float
    cpu_ratio: float
    median_error_px: float


@dataclass(frozen=True)
class SpeedBench:
    """The whole run. reference: time of OpenCV's 5-path SGBM with 96 candidates and blocks of 5.
    reference_error_px: its median absolute error.
    """

    provenance: Provenance
    reference: Timing
    reference_error_px: float
    methods: tuple[SpeedResult, ...]


def bench_speed(methods: Mapping[str, StereoMethod], repeats: int = MIN_REPEATS) -> SpeedBench:
    """Time every method on the same textured pair of two tilted planes with a step between them.

    Each of `repeats` rounds runs SGBM and all methods in turn, after one round that yields the errors.
    """
    pair, candidates, truth_px = speed_pair()
    matcher = _five_path_sgbm(candidates)
    works: list[Callable[[], object]] = [lambda: matcher.compute(pair.left, pair.right)]
    works += [lambda method=method: method(pair, candidates) for method in methods.values()]  # type: ignore[misc]
    fixed = matcher.compute(pair.left, pair.right)
    found = [np.where(fixed >= 0, fixed / np.float32(16), np.float32(np.nan))]
    found += [method(pair, candidates).disparity_px for method in methods.values()]
    errors = [float(np.nanmedian(np.abs(one - truth_px))) for one in found]
    rounds = np.array([[_seconds(work) for work in works] for _ in range(repeats)])
    results = tuple(
        _result(name, rounds[:, i], rounds[:, 0], errors[i]) for i, name in enumerate(methods, start=1)
    )
    return SpeedBench(provenance(), summarise_times(rounds[:, 0, 0]), errors[0], results)


def time_chain(path: Path, repeats: int = MIN_REPEATS) -> tuple[SpeedResult, ...]:
    """Time a recording's first chain of pairs as `measure` matches them for its map, with range and masks.

    The first pair is matched without a prediction, each other pair with one from the pair before. SGBM also
    runs on each pair, with 96 candidates and with the range found in the first pair. A warm-up round isn't
    counted. Raises InputError or MeasurementError if the recording has no such chain.
    """
    recording, settings = open_recording(path), MeasureSettings()
    reader = RectifiedPairs(recording, Rectifier(recording.rig))
    match = matching(reader, settings, None, Stopwatch())
    chain = list(islice(reader(), max(match.length, 2)))
    if not all(match.follows(pair.stamp_ns) for pair in chain[1:]):
        lacks = "lacks encoders that say the way between its first pairs, by which they are predicted"
        raise InputError(path, lacks, "give one with crane0")
    pairs = [pair for pair in chain if isinstance(pair, RectifiedPair)]
    candidates = find_disparity_range(pairs[0]) if 1 < len(pairs) == len(chain) else None
    if not isinstance(candidates, DisparityRange):
        raise MeasurementError(f"{path}: needs two pairs or more at its beginning, all of them matched")
    usual = DisparityRange(candidates.lowest_px, candidates.lowest_px + CANDIDATES)
    matchers, rounds = [_five_path_sgbm(one) for one in (usual, candidates)], []
    for _ in range(repeats + 1):
        match = matching(reader, settings, None, Stopwatch())
        for pair in pairs:
            rounds += [_seconds(partial(matcher.compute, pair.left, pair.right)) for matcher in matchers]
            rounds.append(_seconds(partial(match, pair)))
    reference, narrow, own = np.array(rounds).reshape(-1, len(pairs), 3, 2)[1:].transpose(2, 0, 1, 3)
    camera, unknown = pairs[0].camera, float("nan")
    place = f"{path.resolve().name}, {camera.width}x{camera.height}"
    usual_count, narrow_count = (matcher.getNumDisparities() for matcher in matchers)
    return (
        _result(f"{place}: SGBM, {usual_count} candidates", reference, reference, unknown),
        _result(f"{place}: SGBM, {narrow_count} candidates", narrow, reference, unknown),
        _result(f"{place}: first pair", own[:, :1], reference[:, :1], unknown),
        _result(f"{place}: predicted pairs", own[:, 1:], reference[:, 1:], unknown),
    )


def speed_pair() -> tuple[RectifiedPair, DisparityRange, Float32]:
    """Draw a textured 1280x1024 pair with sensor noise; its disparities run from 20 to 80 px."""
    rng = np.random.default_rng(0)
    wide = rng.normal(0, 1, (HEIGHT_PX, WIDTH_PX + CANDIDATES)).astype(np.float32)
    texture = (
        sum(40 * 2**octave * cv2.GaussianBlur(wide, (0, 0), 1.2 * 2**octave) for octave in range(4)) + 110
    )
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX].astype(np.float32)
    shift = 20 + 20 * columns / WIDTH_PX + 10 * rows / HEIGHT_PX + np.where(columns > WIDTH_PX / 2, 30, 0)
    right = np.ascontiguousarray(texture[:, :WIDTH_PX])
    left = cv2.remap(texture, (columns - shift).astype(np.float32), rows, cv2.INTER_CUBIC)
    images: list[UInt8] = [
        np.rint(image + rng.normal(0, 2, image.shape)).clip(0, 255).astype(np.uint8)
        for image in (left, right)
    ]
    return pair_from_images(images[0], images[1]), DisparityRange(0, CANDIDATES), shift.astype(np.float32)


def speed_table(bench: SpeedBench) -> Table:
    """Tabulate the times, one row per method."""
    table = Table(
        title=f"{WIDTH_PX}x{HEIGHT_PX}, {CANDIDATES} candidates where a row says no other; "
        f"{bench.provenance.cores} cores",
        caption="Median (range) of the runs: one a round, all in turn; on a recording one a pair and round. "
        f"wall, times: over OpenCV's 5-path SGBM's of the same turn, {CANDIDATES} candidates; CPU, times: "
        "the same of the processor time of all cores.",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.add_column("method")
    for heading in ("ms", "runs", "wall, times", "CPU, times", "error px"):
        table.add_column(heading, justify="right")
    error = f"{bench.reference_error_px:.3f}"
    table.add_row("OpenCV's 5-path SGBM", *_cells(bench.reference), "1.0", "1.0", error)
    for result in bench.methods:
        ratios = f"{result.ratio:.1f}", f"{result.cpu_ratio:.1f}"
        error = "-" if math.isnan(result.median_error_px) else f"{result.median_error_px:.3f}"
        table.add_row(result.method, *_cells(result.time), *ratios, error)
    return table


def _five_path_sgbm(candidates: DisparityRange) -> cv2.StereoSGBM:
    """Create OpenCV's SGBM with blocks of 5 and the candidates rounded up to a multiple of 16."""
    return cv2.StereoSGBM.create(
        minDisparity=candidates.lowest_px, numDisparities=-(-candidates.count // 16) * 16, blockSize=5,
        P1=200, P2=800, mode=cv2.STEREO_SGBM_MODE_SGBM,
    )  # fmt: skip


def _result(method: str, times: Float64, reference: Float64, error_px: float) -> SpeedResult:
    """Summarise a method's times (..., 2), wall and CPU s, relative to SGBM's in the same rounds."""
    wall, cpu = np.median((times / reference).reshape(-1, 2), axis=0)
    return SpeedResult(method, summarise_times(times[..., 0].ravel()), float(wall), float(cpu), error_px)


def _seconds(work: Callable[[], object]) -> tuple[float, float]:
    """Measure wall time, and CPU time of all cores, s."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - processor


def _cells(time: Timing) -> tuple[str, str]:
    return f"{time.median_ms:.0f} ({time.fastest_ms:.0f}-{time.slowest_ms:.0f})", str(time.repeats)
