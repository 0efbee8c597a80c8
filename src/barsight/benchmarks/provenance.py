"""Record the machine, commit and times of a benchmark, which make its table reproducible."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from barsight.core.arrays import Float64

T = TypeVar("T")
MIN_REPEATS = 5


@dataclass(frozen=True)
class Provenance:
    """commit: of the source, with `+` if files differ from it, or `unknown`. machine: its description."""

    commit: str
    machine: str
    cores: int
    python: str
    numpy: str


@dataclass(frozen=True)
class Timing:
    """Wall time in ms: median, fastest and slowest of `repeats` runs after a warm-up run that compiles."""

    median_ms: float
    fastest_ms: float
    slowest_ms: float
    repeats: int


def provenance() -> Provenance:
    """Record this process's provenance."""
    return Provenance(
        _commit(), _processor(), len(os.sched_getaffinity(0)), platform.python_version(), np.__version__
    )


def time_repeats(work: Callable[[], T], repeats: int = MIN_REPEATS) -> tuple[T, list[float]]:
    """Time `repeats` runs of `work` after a warm-up run: its result, and the wall times, s."""
    result = work()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return result, seconds


def summarise_times(seconds: Sequence[float] | Float64) -> Timing:
    """Summarise the times, s, of `time_repeats`."""
    ms = 1e3 * np.array(seconds)
    return Timing(float(np.median(ms)), float(ms.min()), float(ms.max()), len(seconds))


def _commit() -> str:
    folder = Path(__file__).resolve().parent
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=20,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return found.stdout.strip() or "unknown"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
