"""Run `barsight bench features|matching|front-end`: test detectors and filters against truth, and time
them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from barsight.benchmarks.motion.frontend_speed import bench_front_end, front_end_table
from barsight.benchmarks.motion.matching import bench_features, bench_matching, feature_table, match_table
from barsight.cli.bench.seeds import expect_counts
from barsight.cli.safe_console import SafeConsole
from barsight.core.json_values import write_json
from barsight.features.detectors import DETECTORS, DetectorName

Json = Annotated[Path | None, tyro.conf.arg(name="json")]


def features(
    recordings: tyro.conf.Positional[tuple[Path, ...]],
    detectors: tuple[DetectorName, ...] = DETECTORS,
    count: int = 2000,
    repeats: int = 5,
    save: Json = None,
) -> None:
    """Reproduce the paper's Table 2: number of features and time to detect them.

    Args:
        recordings: Recordings with stored true depth, as `barsight simulate` writes them.
        detectors: Any of sift, surf, orb.
        count: Number of features requested.
        repeats: Runs per detector; times are given as medians and ranges.
        save: JSON file for all figures, with commit and machine.
    """
    expect_counts(count=count, repeats=repeats)
    bench = bench_features(recordings, detectors, count, repeats)
    SafeConsole().print(feature_table(bench))
    if save is not None:
        write_json(save, bench)


def matching(
    recordings: tyro.conf.Positional[tuple[Path, ...]],
    detectors: tuple[DetectorName, ...] = DETECTORS,
    count: int = 2000,
    save: Json = None,
) -> None:
    """Reproduce the paper's Table 3, with the precision and recall of every filter.

    Args:
        recordings: Recordings with stored true depth, encoders and IMU.
        detectors: Any of sift, surf, orb.
        count: Number of features requested.
        save: JSON file for all figures, with commit and machine.
    """
    expect_counts(count=count)
    bench = bench_matching(recordings, detectors, count)
    SafeConsole().print(match_table(bench))
    if save is not None:
        write_json(save, bench)


def front_end(
    recordings: tyro.conf.Positional[tuple[Path, ...]], repeats: int = 3, save: Json = None
) -> None:
    """Measure the front end's speed in pairs per second, with and without the other sensors.

    Args:
        recordings: Any recordings.
        repeats: Runs after a first one that compiles; times are given as medians and ranges.
        save: JSON file for all figures, with commit and machine.
    """
    expect_counts(repeats=repeats)
    bench = bench_front_end(recordings, repeats)
    SafeConsole().print(front_end_table(bench))
    if save is not None:
        write_json(save, bench)
