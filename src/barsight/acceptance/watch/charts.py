"""Compute the control charts of a watched rig, by the normal value and scatter that its surveys show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from barsight.acceptance.watch.record import WatchedFigure, WatchedSurvey
from barsight.registration.agreement import DOUBTFUL

LEARNED = 8
"""Number of surveys after an approval from which the normal mean and scatter are learned."""
SLACK, ALARM = 1.8, 2.8
"""Slack and alarm threshold of the CUSUM, in sigmas of a survey's deviation from the learned mean [Page
1954].

A jump of four sigma is detected within three surveys, and a dozen charts of healthy rigs raise fewer than one
alarm in a thousand surveys. Where stated sigmas are half as large as the scatter, one chart in twelve raises
an alarm within sixty surveys.
"""
DOUBTED, BELIEVED = 0.02, 6
"""Chance below which a scatter as large as that of the surveys so far contradicts the stated sigmas, and the
number of degrees of freedom that the stated sigmas count for where they are then widened.
"""


@dataclass(frozen=True)
class ControlChart:
    """A figure's control chart.

    value: of the latest survey, NaN if it doesn't show the figure. mean, sigma: the normal ones, NaN while
    they are being learned. cusum: larger of both sums. alarmed_at: number of the survey since the approval
    (from 1) that first raised an alarm, None for no alarm.
    """

    name: str
    value: float
    mean: float
    sigma: float
    cusum: float
    alarmed_at: int | None


def control_charts(surveys: Sequence[WatchedSurvey]) -> tuple[ControlChart, ...]:
    """Compute the control charts of all figures over the surveys of one approval, oldest first."""
    names = dict.fromkeys(figure.name for survey in surveys for figure in survey.figures)
    return tuple(_chart(name, surveys) for name in names)


def _chart(name: str, surveys: Sequence[WatchedSurvey]) -> ControlChart:
    rows = [
        (number, figure)
        for number, survey in enumerate(surveys, 1)
        for figure in survey.figures
        if figure.name == name
    ]
    value = rows[-1][1].value if rows[-1][0] == len(surveys) else np.nan
    if len(rows) < LEARNED:
        return ControlChart(name, value, np.nan, np.nan, 0.0, None)
    normal = _LearnedValue.without_stray([figure for _, figure in rows[:LEARNED]])
    up = down = 0.0
    alarmed, sigma, before = None, np.nan, None
    for number, figure in rows[LEARNED:]:
        sigma, off = normal.ratio * figure.sigma, normal.deviation(figure)
        up, down = max(up + off - SLACK, 0.0), max(down - off - SLACK, 0.0)
        if max(up, down) > ALARM and alarmed is None:
            alarmed = number
        normal = normal if before is None else normal.after(before, figure)
        before = figure
    return ControlChart(name, value, normal.mean, sigma, max(up, down), alarmed)


@cache
def _doubted_squares(freedom: float) -> float:
    """Return the sum of squares from which on the stated sigmas are doubted."""
    return float(chi2.isf(DOUBTED, freedom))


@dataclass(frozen=True)
class _LearnedValue:
    """The normal value of a figure: weighted mean of some surveys and its stated sigma. squares, freedom: the
    surveys' scatter by their stated sigmas, as a sum of squares with so many degrees of freedom.
    """

    mean: float
    sigma: float
    squares: float
    freedom: float

    @property
    def ratio(self) -> float:
        """Return the ratio by which the stated sigmas are widened: 1 unless the scatter contradicts them."""
        if self.squares <= _doubted_squares(self.freedom):
            return 1.0
        return self._believed_ratio

    @property
    def _believed_ratio(self) -> float:
        """Return the ratio of the scatter to the stated sigmas, to which these contribute."""
        return math.sqrt((BELIEVED + self.squares) / (BELIEVED + self.freedom))

    @classmethod
    def of(cls, figures: Sequence[WatchedFigure]) -> _LearnedValue:
        """Learn it from surveys."""
        values = np.array([figure.value for figure in figures])
        weights = np.array([figure.sigma for figure in figures]) ** -2.0
        mean = float(weights @ values / weights.sum())
        squares = float(weights @ (values - mean) ** 2)
        return cls(mean, float(weights.sum() ** -0.5), squares, len(values) - 1)

    def after(self, before: WatchedFigure, figure: WatchedFigure) -> _LearnedValue:
        """Learn the scatter, not the mean, from two surveys in sequence: a drift or a jump adds little to
        their differences, each of which counts for two thirds of a degree of freedom.
        """
        step = (figure.value - before.value) / float(np.hypot(figure.sigma, before.sigma))
        return replace(self, squares=self.squares + 2 / 3 * step**2, freedom=self.freedom + 2 / 3)

    @classmethod
    def without_stray(cls, figures: Sequence[WatchedFigure]) -> _LearnedValue:
        """Learn it without one that lies far from the others, by Grubbs' test with their stated sigmas and
        their scatter; it would widen what is normal so far that no jump raised an alarm.
        """
        middle = np.median([figure.value for figure in figures])
        far = max(figures, key=lambda figure: abs(figure.value - middle) / figure.sigma)
        others = cls.of([figure for figure in figures if figure is not far])
        ratio = max(others._believed_ratio, 1.0) / others.ratio
        chance = len(figures) * 2 * student.sf(abs(others.deviation(far)) / ratio, BELIEVED + others.freedom)
        return others if chance < DOUBTFUL else cls.of(figures)

    def deviation(self, figure: WatchedFigure) -> float:
        """Compute a figure's deviation in sigmas of its own and of the mean."""
        return (figure.value - self.mean) / (self.ratio * float(np.hypot(figure.sigma, self.sigma)))
