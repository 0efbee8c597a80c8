"""Keep the least and the most of a figure over windows of time, and tell whether it grows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MAX_WINDOWS = 240
"""Beyond so many, two become one: memory is bounded however long it lasts."""
GROUPS, MIN_GROUPS = 24, 6
"""A trend goes through the extremes of so many spans of time."""
CYCLES = 2.0
WINDOW_S = 20.0
S_PER_H = 3600.0


@dataclass(frozen=True)
class Trend:
    """Growth of a figure an hour with 1 sigma, and its first and last value."""

    per_h: float
    sigma_per_h: float
    first: float
    last: float


class Windows:
    """A figure's least and most in windows of time. last, peak: of all values."""

    def __init__(self) -> None:
        self._width_s = WINDOW_S
        self._windows: list[tuple[int, float, float]] = []
        self.first = self.last = self.peak = float("nan")

    def add(self, at_s: float, value: float) -> None:
        """Take a value; at_s: rising."""
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
        """Fit a line through the least values from after_s on, or the most; None where they are too few.

        cycle_s: after so long all begins anew; each span has `CYCLES` of them. The window that isn't over is
        left out.
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
