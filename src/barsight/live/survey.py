"""Detect when a survey begins and ends, from the crane's travel."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.stamps import seconds_to_ns
from barsight.live.settings import SurveySettings

STILL_M = 0.05
"""Distance in metres from a place within which the crane counts as standing."""
STOOD = "the crane stood, there is nothing to measure"
INTERRUPTED = "interrupted"


class SurveyWatch:
    """Tracks the crane's travel. is_alone: the run is a single survey, which ends only by its length."""

    def __init__(self, settings: SurveySettings, *, is_alone: bool) -> None:
        self._settings, self._is_alone = settings, is_alone
        self._first_ns = self._still_ns = 0
        self._still_m: Float64 | None = None
        self._way_m = 0.0

    def judge(self, now_ns: int, position_m: Float64) -> str:
        """Return why the survey is over, empty if it isn't.

        now_ns: must increase. position_m: (N, 3) the encoders' newest readings; empty if they can't be
        trusted, as they don't end a survey then.
        """
        self._first_ns = self._first_ns or now_ns
        place = position_m[-1] if len(position_m) else self._still_m
        if place is None or self._still_m is None or not len(position_m):
            self._still_m, self._still_ns = place, now_ns
        elif (step := float(np.linalg.norm(place - self._still_m))) > STILL_M:
            self._way_m += step
            self._still_m, self._still_ns = place, now_ns
        settings, stands_ns = self._settings, now_ns - self._still_ns
        if now_ns - self._first_ns >= seconds_to_ns(settings.max_s):
            return f"a survey takes {settings.max_s:g} s at most"
        has_begun = self._way_m >= settings.way_m
        if not self._is_alone and has_begun and stands_ns >= seconds_to_ns(settings.stop_s):
            return "the crane stopped"
        if not self._is_alone and not has_begun and now_ns - self._first_ns >= seconds_to_ns(settings.rest_s):
            return STOOD
        return ""
