"""Check the counts and seeds of a benchmark, and run it over them, on this machine or on the workers of a
Dask cluster.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from barsight.core.errors import ConfigError, MeasurementError
from barsight.core.extras import extra

T = TypeVar("T")
TRIES = 3
"""Number of times that a seed is given to workers before it is abandoned."""


def expect_counts(**counts: int) -> None:
    """Raise ConfigError for a count below 1, by its flag."""
    for name, count in counts.items():
        if count < 1:
            raise ConfigError(f"--{name} {count}: must be 1 or more")


def parse_seeds(seeds: str, bench: str) -> range:
    """Parse `first:last`, where last is not included. Raises ConfigError that names the benchmark."""
    match = re.fullmatch(r"(\d+):(\d+)", seeds)
    if match is None or int(match[2]) <= int(match[1]):
        raise ConfigError(f"{bench}: seeds {seeds!r} is not like 500:560, the last not included")
    return range(int(match[1]), int(match[2]))


def over_seeds(
    run: Callable[[int, Any], T], seeds: range, given: Any, workers: int, scheduler: str | None
) -> Iterator[tuple[int, T]]:
    """Run `run(seed, given)` for each seed, and yield each seed with its result as it finishes.

    workers: number of processes on this machine, which share its cores; 1 runs in this process. scheduler:
    address of a Dask cluster to use instead. Raises MeasurementError for a seed whose workers die, and
    whatever `run` raises.
    """
    if workers < 1:
        raise ConfigError(f"bench: workers must be 1 or more, not {workers}")
    if workers == 1 and scheduler is None:
        for seed in seeds:
            yield seed, run(seed, given)
        return
    with extra("fleet"):
        from barsight.fleet.cluster import connect, run_all
        from barsight.fleet.versions import installed_software
    left = set(seeds)
    shared = (run, given, installed_software())
    with connect(workers, scheduler, threads=max(1, (os.cpu_count() or 1) // workers)) as client:
        for _ in range(TRIES):
            for ended in run_all(client, _one_seed, sorted(left), shared):
                if ended is not None:
                    left.discard(ended[0])
                    yield ended
            if not left:
                return
    raise MeasurementError(f"seeds {', '.join(map(str, sorted(left)))}: their workers died {TRIES} times")


def _one_seed(seed: int, shared: tuple[Callable[[int, Any], T], Any, str]) -> tuple[int, T]:
    """Run one seed on a worker, which must have the same software as the caller."""
    from barsight.fleet.versions import expect_software

    run, given, software = shared
    expect_software(software)
    return seed, run(seed, given)
