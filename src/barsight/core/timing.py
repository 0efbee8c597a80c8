"""Time the stages of a run and count their frames."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

ProgressCallback = Callable[[str, int, int], None]
"""Callback for progress: stage, frames done, total frames."""


class Stopwatch:
    """Adds up seconds and frames by stage, from any thread; overlapping stages count in full each."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._frames: dict[str, int] = {}
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def __call__(self, stage: str, frames: int = 0) -> Iterator[None]:
        """Time the block under it, whether or not it raises."""
        start = time.perf_counter()
        try:
            yield
        finally:
            with self._lock:
                self._seconds[stage] = self._seconds.get(stage, 0.0) + time.perf_counter() - start
                self._frames[stage] = self._frames.get(stage, 0) + frames

    def entries(self) -> tuple[tuple[str, float, int], ...]:
        """Return (stage, seconds, frames) in the order in which the stages first ended."""
        return tuple((stage, seconds, self._frames[stage]) for stage, seconds in self._seconds.items())


def count_frames(stage: str, total: int, advance: ProgressCallback) -> Callable[[], None]:
    """Count a stage's frames: each call reports one more of `total` to `advance(stage, done, total)`."""
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        advance(stage, done, total)

    return count


def unwatched() -> None:
    """Ignore a sign of progress."""
