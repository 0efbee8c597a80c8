"""Run a command under limits of memory and time, and report in one line why it failed."""

from __future__ import annotations

import contextlib
import ctypes
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from barsight.core.errors import Failed, OutputError
from barsight.core.extras import extra

with extra("fleet"):
    import psutil

_LOOK_S = 0.1
GIB = 1 << 30
_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


@dataclass(frozen=True)
class LimitedRun:
    """A successful command. peak_bytes: peak resident memory of it and its children together."""

    seconds: float
    peak_bytes: int


def thread_variables(threads: int) -> dict[str, str]:
    """Form the environment that limits a process's threads; empty for 0, which sets no limit."""
    return dict.fromkeys(_THREADS, str(threads)) if threads else {}


def run_limited(
    command: Sequence[str], folder: Path, environment: Mapping[str, str], memory_gib: float, timeout_s: float
) -> LimitedRun | Failed:
    """Run a command in `folder`; it is killed with its children at a limit, or if this process dies.

    Fails with `over-memory`, `timeout`, or `refused` and its last line of output; `output` if that line is
    about output that it could not write.
    """
    started = time.monotonic()
    peak = 0
    with (folder / "measure.log").open("wb") as log:
        process = subprocess.Popen(
            command, cwd=folder, env=dict(environment), stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            start_new_session=True, preexec_fn=_die_with_parent if sys.platform == "linux" else None,
        )  # fmt: skip
        try:
            while process.poll() is None:
                peak = max(peak, _resident(process.pid))
                if peak > memory_gib * GIB:
                    reason = f"took {peak / GIB:.2f} GiB of memory, {memory_gib:g} GiB are allowed"
                    return Failed("over-memory", reason)
                if time.monotonic() - started > timeout_s:
                    return Failed("timeout", f"did not end in {timeout_s:g} s")
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_LOOK_S)
        finally:
            _kill(process)
    if process.returncode == 0:
        return LimitedRun(time.monotonic() - started, peak)
    lines = (folder / "measure.log").read_bytes()[-4000:].decode(errors="replace").strip().splitlines()
    line = (lines or ["no word"])[-1]
    code = "output" if process.returncode == OutputError.exit_code else "refused"
    ended = f"exit code {process.returncode}" if process.returncode > 0 else f"signal {-process.returncode}"
    return Failed(code, f"{ended}: {line}")


def _die_with_parent() -> None:
    """Ask the kernel to kill this process when its parent dies (PR_SET_PDEATHSIG)."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def _resident(pid: int) -> int:
    total = 0
    with contextlib.suppress(psutil.Error):
        first = psutil.Process(pid)
        for one in (first, *first.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                total += one.memory_info().rss
    return total


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is not None:
        return
    with contextlib.suppress(psutil.Error):
        for one in psutil.Process(process.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                one.kill()
    process.kill()
    process.wait()
