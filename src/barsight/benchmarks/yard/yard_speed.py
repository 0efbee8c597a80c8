"""Time bundle detection and lift planning on a whole yard of 35 m."""

from __future__ import annotations

import time
from dataclasses import dataclass

from barsight.benchmarks.yard.bundle_detection import drawn_map, drawn_yards
from barsight.core.memory import peak_memory_mib
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.targets import plan_lifts
from barsight.yard.magnet.description import Magnet

LENGTH_M = 35.0


@dataclass(frozen=True)
class YardSpeed:
    """Wall and CPU times, s, for a drawn yard; the process's peak memory, drawing included."""

    length_m: float
    bundles: int
    bundles_s: float
    bundles_cpu_s: float
    lifts_s: float
    lifts_cpu_s: float
    peak_mib: float

    def __str__(self) -> str:
        return (
            f"{self.length_m:g} m, {self.bundles} bundles: "
            f"bundles {self.bundles_s:.1f} s (CPU {self.bundles_cpu_s:.1f} s), "
            f"lifts {self.lifts_s:.1f} s (CPU {self.lifts_cpu_s:.1f} s), peak {self.peak_mib:.0f} MiB"
        )


def time_yard(magnet: Magnet, seed: int, length_m: float = LENGTH_M) -> YardSpeed:
    """Draw one yard, detect its bundles and plan its lifts, after a warm-up on a short yard."""
    for length in (2.0, length_m):
        height_map, _ = drawn_map(next(drawn_yards(1, seed, length)))
        wall, cpu = [time.perf_counter()], [time.process_time()]
        bundles = find_bundles(height_map, BundleSettings())
        wall.append(time.perf_counter())
        cpu.append(time.process_time())
        plan_lifts(height_map, bundles, magnet, LiftSettings(), ())
        wall.append(time.perf_counter())
        cpu.append(time.process_time())
    return YardSpeed(
        length_m, len(bundles), wall[1] - wall[0], cpu[1] - cpu[0], wall[2] - wall[1], cpu[2] - cpu[1],
        peak_memory_mib(),
    )  # fmt: skip
