"""Keep minimum and maximum of a quantity in time windows, and estimate whether it grows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MAX_WINDOWS = 240
"""Maximum number of windows; beyond it they are merged in pairs, so that memory is bounded for any
duration.
"""
GROUPS, MIN_GROUPS = 24, 6
"""Maximum and minimum number of time spans through whose extremes a trend is fitted."""
CYCLES = 2.0
WINDOW_S = 20.0
S_PER_H = 3600.0


@dataclass(frozen=True)
class Trend:
    """Growth of a quantity per hour with 1 sigma, and its first and last value."""

    per_h: float
    sigma_per_h: float
    first: float
    last: float


class Windows:
    """Minimum and maximum of a quantity in time windows. last, peak: of all values."""

    def __init__(self) -> None:
        self._width_s = WINDOW_S
        self._windows: list[tuple[int, float, float]] = []
        self.first = self.last = self.peak = float("nan")

    def add(self, at_s: float, value: float) -> None:
        """Add a value; at_s must increase."""
        if not self._windows:
            self.first = self.peak = value
        self.last, self.peak = value, max(self.peak, value)
        self._put(int(at_s // self._width_s), value, value)
        if len(self._windows) > MAX_WINDOWS:
            self._width_s *= 2
            halved, self._windows = self._windows, []
            for number, low, high in halved:
                self._put(number // 2, low, high)

    def trend(self, after_s: float, cycle_s: float, *, of_peaks: bool) -> Trend | None:
        """Fit a line through the minima from after_s on, or the maxima; None if there are too few.

        cycle_s: period after which everything begins anew; each span covers at least `CYCLES` of them. The
        window in progress is left out.
        """
        first = int(np.ceil(after_s / self._width_s))
        whole = [one for one in self._windows[:-1] if one[0] >= first]
        each = max(-(-len(whole) // GROUPS), int(np.ceil(CYCLES * cycle_s / self._width_s)))
        count = len(whole) // each if each else 0
        if count < MIN_GROUPS:
            return None
        groups = np.array(whole[len(whole) - count * each :]).reshape(count, each, 3)
        at_h = (groups[:, :, 0].mean(axis=1) + 0.5) * self._width_s / S_PER_H
        values = groups[:, :, 2].max(axis=1) if of_peaks else groups[:, :, 1].min(axis=1)
        away = at_h - at_h.mean()
        per_h = float(away @ values / (away @ away))
        left = values - values.mean() - per_h * away
        sigma = float(np.sqrt(left @ left / (count - 2) / (away @ away)))
        return Trend(per_h, sigma, float(values[0]), float(values[-1]))

    def _put(self, number: int, low: float, high: float) -> None:
        if self._windows and self._windows[-1][0] == number:
            _, before, after = self._windows.pop()
            low, high = min(low, before), max(high, after)
        self._windows.append((number, low, high))
