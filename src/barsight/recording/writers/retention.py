"""Keep a disk from filling up: delete the oldest segments of earlier recordings, except protected ones."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from barsight.core.files import is_held
from barsight.recording.formats.segments import PATTERN

PROTECTED = "PROTECTED"
"""Name of a file that protects the recording whose folder it is in."""


def used_ratio(folder: Path) -> float:
    """Compute the share of the disk in use, of the space available to users other than root."""
    usage = shutil.disk_usage(folder)
    return usage.used / max(usage.used + usage.free, 1)


def oldest_first(folders: Iterable[Path], newest: str) -> list[Path]:
    """Sort folders that are named by their start, the oldest first.

    newest: name of the one written last. Those named later are older: the clock was wrong then, and was set
    back since.
    """
    return sorted(folders, key=lambda folder: (folder.name <= newest, folder.name))


class Retention:
    """Cleans up the folder that contains the recording `current` and earlier ones.

    is_full: whether the disk is fuller than `stop_used_ratio`, so that nothing more may be recorded.
    """

    def __init__(
        self, current: Path, max_used_ratio: float, stop_used_ratio: float,
        measure: Callable[[Path], float] = used_ratio,
    ) -> None:  # fmt: skip
        self._current, self._max, self._stop, self._measure = (
            current,
            max_used_ratio,
            stop_used_ratio,
            measure,
        )
        self.is_full = False

    def tidy(self) -> int:
        """Delete the oldest segments until the disk's use is below `max_used_ratio`; return how many."""
        deleted = 0
        for path in self._deletable():
            if self._measure(self._current) < self._max:
                break
            path.unlink(missing_ok=True)
            deleted += 1
            if not any(path.parent.glob(PATTERN)):
                shutil.rmtree(path.parent, ignore_errors=True)
        self.is_full = self._measure(self._current) >= self._stop
        return deleted

    def _deletable(self) -> list[Path]:
        """List the segments of the other recordings, the oldest first, but not of one that a run writes or
        measures.
        """
        return [
            path
            for folder in oldest_first(self._current.parent.iterdir(), self._current.name)
            if folder.is_dir()
            and folder != self._current
            and not (folder / PROTECTED).exists()
            and not is_held(folder)
            for path in sorted(folder.glob(PATTERN))
        ]
