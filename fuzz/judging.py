"""Run one command on damaged input in a process of its own, and judge how it ended."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from barsight.core.errors import BarsightError
from fuzz.mutators import MARK, SECRET

MAX_SECONDS, MAX_WALL_SECONDS = 10.0, 60.0
"""Of the processor, and by the clock: a busy machine is slow, a run that waits for ever does nothing."""
MAX_BYTES = 2 << 30
ADDRESS_SPACE = 12 << 30
"""Limit of what a run may reserve; what it really takes is judged by MAX_BYTES."""
CODES = (0, 1, 2, 3, 4, 5)
MAX_LINES = 2
USAGE_ERROR = 2


@dataclass(frozen=True)
class Verdict:
    """fault: what the run did that it must not; empty where it did nothing such. text: its standard error."""

    fault: str
    code: int
    seconds: float
    text: str


def judge(run: Callable[[], int], scratch: Path, outputs: tuple[Path, ...] = ()) -> Verdict:
    """Fork, run and judge. outputs: files or folders that must be as before where the run fails."""
    before = [_state(path) for path in outputs]
    pid, began = os.fork(), time.monotonic()
    if pid == 0:
        _child(run, scratch)
    code, peak, seconds = _wait(pid, began)
    text = (scratch / "stderr").read_text(encoding="utf-8", errors="replace")
    fault = _fault(code, peak, seconds, text)
    if not fault and code:
        after = [_state(path) for path in outputs]
        if before != after:
            fault = "half result"
    if not fault and (stolen := _stolen(outputs)):
        fault = f"stolen: {stolen} holds or changed what lies elsewhere"
    left = [path.name for path in scratch.rglob(".*.part")]
    if not fault and left:
        fault = f"left {left[0]}"
    return Verdict(fault, code, seconds, text)


def _child(run: Callable[[], int], scratch: Path) -> None:
    code = 250
    try:
        os.chdir(scratch)
        for number, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(os.open(scratch / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CPU, (int(2 * MAX_SECONDS), int(2 * MAX_SECONDS)))
        sys.stdout, sys.stderr = (
            os.fdopen(number, "w", errors=errors)
            for number, errors in ((1, "strict"), (2, "backslashreplace"))
        )
        warnings.simplefilter("ignore")  # as the console script does
        try:
            code = run()
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else 1
        except BarsightError as error:
            sys.stderr.write(f"barsight: {error}\n")
            code = error.exit_code
        except BaseException:
            traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _wait(pid: int, began: float) -> tuple[int, int, float]:
    """Return the exit code (-N for a signal), the peak bytes and the processor's seconds; the child is killed
    where it takes too long.
    """
    while True:
        found, status, used = os.wait4(pid, os.WNOHANG)
        late = not found and time.monotonic() - began > MAX_WALL_SECONDS
        if late:
            os.kill(pid, signal.SIGKILL)
            found, status, used = os.wait4(pid, 0)
        if found:
            seconds = MAX_WALL_SECONDS if late else used.ru_utime + used.ru_stime
            return os.waitstatus_to_exitcode(status), used.ru_maxrss * 1024, seconds
        time.sleep(0.002)


def _fault(code: int, peak: int, seconds: float, text: str) -> str:
    if seconds > MAX_SECONDS:
        return "hang"
    if peak > MAX_BYTES:
        return f"{peak / 2**30:.1f} GiB"
    if "Traceback" in text:
        lines = [line for line in text.strip().splitlines() if line.strip()]
        return f"traceback: {lines[-1][:120]}"
    if code not in CODES:
        return f"exit code {code}"
    if code and not (1 <= text.count("\n") <= MAX_LINES):
        return f"{text.count(chr(10))} lines"
    if any((ord(sign) < 32 and sign not in "\n\t") or 127 <= ord(sign) < 160 for sign in text):
        return "control characters"
    return ""


def _stolen(outputs: tuple[Path, ...]) -> str:
    """Name what holds the secret, where anything does; the secret itself where it was changed."""
    if SECRET.read_bytes() != MARK:
        return str(SECRET)
    for output in outputs:
        for path in output.rglob("*") if output.is_dir() else (output,):
            small = path.is_file() and not path.is_symlink() and path.stat().st_size < 1 << 26
            if small and MARK.strip() in path.read_bytes():
                return path.name
    return ""


def _state(path: Path) -> object:
    """Describe a file or a folder's files so that any change shows."""
    if path.is_dir():
        return {each.relative_to(path): _stamp(each) for each in sorted(path.rglob("*"))}
    return _stamp(path)


def _stamp(path: Path) -> tuple[int, ...] | None:
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns if path.is_file() else 0
