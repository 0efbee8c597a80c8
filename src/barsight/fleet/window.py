"""Decide whether new tasks may start now: only at night, or only while the machine has idle cores."""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import datetime, time

from barsight.core.errors import ConfigError
from barsight.core.extras import extra

with extra("fleet"):
    import psutil


@dataclass(frozen=True)
class RunWindow:
    """Times at which tasks may start."""

    between: tuple[str, str] | None = None
    """Start recordings only between two local times, like 22:00 06:00."""
    idle: bool = False
    """Start a recording only while this machine has an idle core."""

    def __post_init__(self) -> None:
        if self.between is not None:
            for text in self.between:
                _clock(text)

    @property
    def is_limited(self) -> bool:
        """Return True if the window may ever be closed."""
        return self.between is not None or self.idle

    def is_open(self, now: datetime | None = None, busy_ratio: float | None = None) -> bool:
        """Check the clock and the machine's load. busy_ratio: share of the cores at work, or None."""
        if self.between is not None:
            start, end = map(_clock, self.between)
            at = (now or datetime.now().astimezone()).time()
            is_night = start <= at < end if start <= end else at >= start or at < end
            if not is_night:
                return False
        if not self.idle:
            return True
        busy = psutil.cpu_percent(interval=1.0) / 100 if busy_ratio is None else busy_ratio
        return (1 - busy) * (os.cpu_count() or 1) >= 0.5


def _clock(text: str) -> time:
    try:
        return datetime.strptime(text, "%H:%M").time()
    except ValueError:
        raise ConfigError(f"--between {text!r}: is not a time of day; write it like 22:00") from None
