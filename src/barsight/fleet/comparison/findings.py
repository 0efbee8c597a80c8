"""Judge all comparisons of an archive together: significant differences under multiple testing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean, median

import numpy as np
from scipy.stats import ttest_1samp

from barsight.fleet.comparison.comparing import FIGURES, FigureChange, RecordingComparison

LEVEL = 0.05
"""Family-wise error rate for two versions that measure alike, once for the bundles, once for the shifts of
the whole archive, and once for what forbids lifts.
"""
MIN_RECORDINGS = 5
"""Minimum number of recordings for which a shift of the archive can be distinguished from chance."""


@dataclass(frozen=True)
class ArchiveShift:
    """A shift common to the recordings.

    shift: mean over the recordings of each one's median difference, or of the additional lifts that a code
    forbids; p: of Student's t over the recordings. is_found: significant by Holm's method over the
    quantities, or the codes.
    """

    figure: str
    recordings: int
    shift: float
    p: float
    is_found: bool


@dataclass(frozen=True)
class Findings:
    """Findings on two versions.

    beyond: bundles beyond sigma, the least likely first. tests: number of quantities tested. lifts: shifts of
    the codes that forbid single lifts, and of `offered`. untold: recordings missing in one of the versions.
    """

    before: str
    after: str
    tests: int
    beyond: tuple[FigureChange, ...]
    shifts: tuple[ArchiveShift, ...]
    lifts: tuple[ArchiveShift, ...]
    recordings: tuple[RecordingComparison, ...]
    untold: tuple[str, ...]

    @property
    def seconds(self) -> tuple[float, float]:
        """Return the median seconds of a measurement, before and after."""
        if not self.recordings:
            return 0.0, 0.0
        return (
            median(one.seconds[0] for one in self.recordings),
            median(one.seconds[1] for one in self.recordings),
        )


def judge(
    before: str, after: str, recordings: Sequence[RecordingComparison], untold: Sequence[str]
) -> Findings:
    """Find the bundles beyond sigma and the shifts of the archive, each by Holm's method at LEVEL."""
    changes = [change for one in recordings for change in one.changes]
    found = holm([change.p for change in changes])
    beyond = sorted((c for c, is_found in zip(changes, found, strict=True) if is_found), key=lambda c: c.p)
    return Findings(
        before, after, len(changes), tuple(beyond), _shifts(recordings), _lift_shifts(recordings),
        tuple(recordings), tuple(untold),
    )  # fmt: skip


def holm(chances: Sequence[float]) -> list[bool]:
    """Find the significant p-values, with a family-wise error rate of at most LEVEL.

    Source: Holm, "A simple sequentially rejective multiple test procedure", 1979.
    """
    found = [False] * len(chances)
    for rank, place in enumerate(sorted(range(len(chances)), key=lambda i: chances[i])):
        if chances[place] > LEVEL / (len(chances) - rank):
            break
        found[place] = True
    return found


def _shifts(recordings: Sequence[RecordingComparison]) -> tuple[ArchiveShift, ...]:
    """Judge the median difference of each recording, by quantity."""
    return _judged({
        figure: [
            median(differences)
            for one in recordings
            if (differences := [c.after - c.before for c in one.changes if c.figure == figure])
        ]
        for figure in FIGURES
    })  # fmt: skip


def _lift_shifts(recordings: Sequence[RecordingComparison]) -> tuple[ArchiveShift, ...]:
    """Judge how many more lifts each code forbids, by recording."""
    codes = sorted({code for one in recordings for code in one.lifts})
    none = (0, 0)
    return _judged({
        code: [float(after - before) for one in recordings for before, after in [one.lifts.get(code, none)]]
        for code in codes
    })  # fmt: skip


def _judged(by_name: dict[str, list[float]]) -> tuple[ArchiveShift, ...]:
    rows = [
        (name, len(values), mean(values) if values else 0.0, _chance(values))
        for name, values in by_name.items()
    ]
    found = holm([row[3] for row in rows])
    return tuple(ArchiveShift(*row, is_found) for row, is_found in zip(rows, found, strict=True))


def _chance(values: list[float]) -> float:
    if len(values) < MIN_RECORDINGS or not any(values):
        return 1.0
    if np.ptp(values) == 0:
        return 0.0
    return float(ttest_1samp(values, 0.0).pvalue)
