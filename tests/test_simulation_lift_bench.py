"""The bench of lifts: no wrong count without a veto, few vetoes on what is truly fine, on two small yards."""

from __future__ import annotations

from barsight.benchmarks.yard.lift_targets import bench_lifts, bench_yard, count_truly
from barsight.yard.lifting.footprint import Placement
from lift_yards import MAGNET


def test_counts_are_right_or_vetoed_and_fine_lifts_pass() -> None:
    bench = bench_lifts(MAGNET, 4, 120, None, lambda done: None)
    assert bench.placements == 120 and bench.wrong == 0
    assert bench.fine > 20 and bench.counted > 20
    # The drawn errors are larger than a measured map's: some stand above the faces' plane for `obstructed`.
    assert bench.vetoed_fine <= 0.3 * bench.fine
    assert sum(bench.codes.values()) > 20


def test_the_true_count_is_that_of_the_stock() -> None:
    known, _ = bench_yard(0)
    first, second = sorted((b for b in known.bundles if b.on_top), key=lambda b: float(b.centre_m[0]))[:2]
    place = Placement(float(first.centre_m[0]), float(first.centre_m[1]), first.yaw_rad)
    assert count_truly(place, known, MAGNET) == 1
    between = (first.centre_m + second.centre_m) / 2
    if second.centre_m[0] - first.centre_m[0] < first.width_m + 0.05:
        assert count_truly(Placement(float(between[0]), float(between[1]), first.yaw_rad), known, MAGNET) == 2
