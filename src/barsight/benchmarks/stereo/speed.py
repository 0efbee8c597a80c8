"""Time every method on 1280x1024 with 96 candidates (`bench stereo-speed`), against OpenCV's 5-path SGBM."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from rich.table import Table

from barsight.benchmarks.provenance import MIN_REPEATS, Provenance, Timing, provenance, summarise_times
from barsight.core.arrays import Float32, UInt8
from barsight.core.types import DisparityRange, RectifiedPair
from barsight.stereo.image_pair import pair_from_images
from barsight.stereo.method import StereoMethod

WIDTH_PX, HEIGHT_PX, CANDIDATES = 1280, 1024, 96


@dataclass(frozen=True)
class SpeedResult:
    """One method. ratio: its wall time over OpenCV's 5-path SGBM's, median of the rounds. cpu_ratio: the same
    of the processor time of all cores: what other programs on the machine take doesn't count there.
    median_error_px: of the absolute error where there is a disparity.
    """

    method: str
    time: Timing
    ratio: float
    cpu_ratio: float
    median_error_px: float


@dataclass(frozen=True)
class SpeedBench:
    """The whole run. reference: OpenCV's 5-path SGBM alone, 96 candidates, blocks of 5.
    reference_error_px: its median error.
    """

    provenance: Provenance
    reference: Timing
    reference_error_px: float
    methods: tuple[SpeedResult, ...]


def bench_speed(methods: Mapping[str, StereoMethod], repeats: int = MIN_REPEATS) -> SpeedBench:
    """Time every method on the same textured pair, two tilted planes with a step between them: in each of
    `repeats` rounds SGBM and all methods in turn, after one round that gives the errors.
    """
    pair, candidates, truth_px = speed_pair()
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=CANDIDATES, blockSize=5, P1=200, P2=800, mode=cv2.STEREO_SGBM_MODE_SGBM
    )
    works: list[Callable[[], object]] = [lambda: matcher.compute(pair.left, pair.right)]
    works += [lambda method=method: method(pair, candidates) for method in methods.values()]  # type: ignore[misc]
    fixed = matcher.compute(pair.left, pair.right)
    found = [np.where(fixed >= 0, fixed / np.float32(16), np.float32(np.nan))]
    found += [method(pair, candidates).disparity_px for method in methods.values()]
    errors = [float(np.nanmedian(np.abs(one - truth_px))) for one in found]
    rounds = np.array([[_seconds(work) for work in works] for _ in range(repeats)])
    ratios = np.median(rounds / rounds[:, :1], axis=0)
    results = tuple(
        SpeedResult(
            name, summarise_times(rounds[:, i, 0]), float(ratios[i, 0]), float(ratios[i, 1]), errors[i]
        )
        for i, name in enumerate(methods, start=1)
    )
    return SpeedBench(provenance(), summarise_times(rounds[:, 0, 0]), errors[0], results)


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
    """Tabulate one row per method."""
    table = Table(
        title=f"{WIDTH_PX}x{HEIGHT_PX}, {CANDIDATES} candidates, {bench.provenance.cores} cores",
        caption=f"Median (range) of {bench.reference.repeats} rounds, all in turn. times SGBM: wall time "
        "over OpenCV's 5-path SGBM's of the same round; processor time: the same of all cores' together.",
    )
    table.add_column("method")
    for heading in ("ms", "times SGBM", "processor time", "median error px"):
        table.add_column(heading, justify="right")
    table.add_row(
        "OpenCV's 5-path SGBM", _cell(bench.reference), "1.0", "1.0", f"{bench.reference_error_px:.3f}"
    )
    for result in bench.methods:
        ratios = f"{result.ratio:.1f}", f"{result.cpu_ratio:.1f}"
        table.add_row(result.method, _cell(result.time), *ratios, f"{result.median_error_px:.3f}")
    return table


def _seconds(work: Callable[[], object]) -> tuple[float, float]:
    """Measure wall time, and processor time of all cores."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - processor


def _cell(time: Timing) -> str:
    return f"{time.median_ms:.0f} ({time.fastest_ms:.0f}-{time.slowest_ms:.0f})"
