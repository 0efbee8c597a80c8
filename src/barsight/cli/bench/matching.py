"""Run `barsight bench features|matching|front-end`: detectors and filters against truth, and their speed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from barsight.benchmarks.motion.frontend_speed import bench_front_end, front_end_table
from barsight.benchmarks.motion.matching import bench_features, bench_matching, feature_table, match_table
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
    """Reproduce the paper's Table 2: number and time of features.

    Args:
        recordings: Recordings with stored true depth, as `barsight simulate` makes them.
        detectors: Any of sift, surf, orb.
        count: Features asked for.
        repeats: Runs per detector; times are medians and ranges.
        save: JSON file for all figures, with commit and machine.
    """
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
    """Reproduce the paper's Table 3 with the precision and recall of every filter.

    Args:
        recordings: Recordings with stored true depth, encoders and IMU.
        detectors: Any of sift, surf, orb.
        count: Features asked for.
        save: JSON file for all figures, with commit and machine.
    """
    bench = bench_matching(recordings, detectors, count)
    SafeConsole().print(match_table(bench))
    if save is not None:
        write_json(save, bench)


def front_end(
    recordings: tyro.conf.Positional[tuple[Path, ...]], repeats: int = 3, save: Json = None
) -> None:
    """Time the front end in pairs a second, with and without the other sensors.

    Args:
        recordings: Any recordings.
        repeats: Runs after one that compiles; times are medians and ranges.
        save: JSON file for all figures, with commit and machine.
    """
    bench = bench_front_end(recordings, repeats)
    SafeConsole().print(front_end_table(bench))
    if save is not None:
        write_json(save, bench)
