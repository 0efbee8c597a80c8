"""`bench speed`: wall time of every method on a 1280x1024 pair with 96 candidates, against OpenCV's SGBM."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from rich.table import Table

from barsight.core.arrays import UInt8
from barsight.core.types import Disparity, DisparityRange, RectifiedPair
from barsight.evaluation.stereo_provenance import LEAST_REPEATS, Provenance, Timing, provenance, timed, timing
from barsight.evaluation.stereo_scenes import pair_from_images
from barsight.stereo.method import StereoMethod

WIDTH_PX, HEIGHT_PX, CANDIDATES = 1280, 1024, 96


@dataclass(frozen=True)
class SpeedResult:
    """One method's wall time, and how many times OpenCV's 5-path SGBM takes it."""

    method: str
    time: Timing
    ratio: float


@dataclass(frozen=True)
class SpeedBench:
    """The whole run. reference: OpenCV's 5-path SGBM alone, 96 candidates, blocks of 5."""

    provenance: Provenance
    reference: Timing
    methods: tuple[SpeedResult, ...]


def bench_speed(methods: Mapping[str, StereoMethod], repeats: int = LEAST_REPEATS) -> SpeedBench:
    """Time every method on the same textured pair: two tilted planes with a step between them."""
    pair, candidates = speed_pair()
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=CANDIDATES, blockSize=5, P1=200, P2=800, mode=cv2.STEREO_SGBM_MODE_SGBM
    )
    _, seconds = timed(lambda: matcher.compute(pair.left, pair.right), repeats)
    reference = timing(seconds)
    results = []
    for name, method in methods.items():
        taken = timing(_seconds(method, pair, candidates, repeats))
        results.append(SpeedResult(name, taken, taken.median_ms / reference.median_ms))
    return SpeedBench(provenance(), reference, tuple(results))


def speed_pair() -> tuple[RectifiedPair, DisparityRange]:
    """A textured 1280x1024 pair whose disparities run from 20 to 80 px, with sensor noise."""
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
    return pair_from_images(images[0], images[1]), DisparityRange(0, CANDIDATES)


def speed_table(bench: SpeedBench) -> Table:
    """One row per method."""
    table = Table(
        title=f"{WIDTH_PX}x{HEIGHT_PX}, {CANDIDATES} candidates, {bench.provenance.cores} cores",
        caption=f"Median (range) of {bench.reference.repeats} runs; times OpenCV's 5-path SGBM.",
    )
    table.add_column("method")
    for heading in ("ms", "times SGBM"):
        table.add_column(heading, justify="right")
    table.add_row("OpenCV's 5-path SGBM", _cell(bench.reference), "1.0")
    for result in bench.methods:
        table.add_row(result.method, _cell(result.time), f"{result.ratio:.1f}")
    return table


def _seconds(
    method: StereoMethod, pair: RectifiedPair, candidates: DisparityRange, repeats: int
) -> list[float]:
    def run() -> Disparity:
        return method(pair, candidates)

    return timed(run, repeats)[1]


def _cell(time: Timing) -> str:
    return f"{time.median_ms:.0f} ({time.fastest_ms:.0f}-{time.slowest_ms:.0f})"
