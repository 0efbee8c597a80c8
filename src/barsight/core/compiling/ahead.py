"""Compile kernels ahead, in several processes: one process compiles a single kernel at a time."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable

import numba

from barsight.core.compiling.signatures import listed

MAX_PROCESSES = 4
"""Maximum number of compiling processes. Each takes half a gigabyte, and the more there are, the more of them
compile the same functions.
"""
MIN_KERNELS = 8
"""Minimum number of kernels for which starting processes pays."""
_PLACE_BYTES = 4


def compile_ahead(advance: Callable[[str, int, int], None], *groups: str) -> None:
    """Compile those kernels of some groups ("simulate", "measure") that the cache lacks, on all cores.

    advance: told of progress (stage, done, total). Where processes can't be started, or can't write, each
    kernel is compiled at its first call, as it is on one core.
    """
    cores = min(numba.config.NUMBA_NUM_THREADS, MAX_PROCESSES)
    if cores < 2 or numba.config.DISABLE_JIT or not sys.executable:
        return
    missing = [place for place, one in enumerate(listed(*groups)) if one.missing()]
    if len(missing) < MIN_KERNELS:
        return
    read_place, write_place = os.pipe()
    read_done, write_done = os.pipe()
    os.write(write_place, b"".join(place.to_bytes(_PLACE_BYTES) for place in missing))
    os.close(write_place)
    command = [sys.executable, "-P", "-m", __name__, *groups]
    workers = list[subprocess.Popen[bytes]]()
    # Fewer processes do, where no more may be started.
    with contextlib.suppress(OSError):
        while len(workers) < cores:
            workers.append(
                subprocess.Popen(command, stdin=read_place, stdout=write_done, stderr=subprocess.DEVNULL)
            )
    os.close(read_place)
    os.close(write_done)
    try:
        done = 0
        advance("compile", done, len(missing))
        while os.read(read_done, _PLACE_BYTES):
            done += 1
            advance("compile", done, len(missing))
    finally:
        os.close(read_done)
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.wait()


def load_kernels(*groups: str) -> None:
    """Load the kernels of some groups from the cache now rather than at each one's first call.

    A kernel whose listed types belong to an earlier version is left to its first call.
    """
    if not numba.config.DISABLE_JIT:
        for one in listed(*groups):
            with contextlib.suppress(numba.errors.NumbaError):
                one.compile()


def main() -> None:
    """Compile the kernels whose list indices are given on standard input, and report each one when it is
    done.
    """
    kernels = listed(*sys.argv[1:])
    while place := os.read(0, _PLACE_BYTES):
        with contextlib.suppress(Exception):  # the first call says what is wrong
            kernels[int.from_bytes(place)].compile()
        os.write(1, place)


if __name__ == "__main__":
    main()
