"""Dispatch `barsight COMMAND ...` and report a user's mistake in one line."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from types import FrameType

import barsight
from barsight.core.errors import BarsightError
from barsight.core.memory import bound_heap
from barsight.core.printing import printable

COMMANDS = {
    "plan": "Plan a rig: lens, baseline, exposure, frame rate and data rate, with a parts list",
    "demo": "Try Barsight: simulate a small yard, measure it, compare it with truth and laser",
    "measure": "Measure a stereo recording: map, trajectory, bundles, lifts and report",
    "live": "Measure while the crane travels, from its sensors or a replayed recording",
    "lifts": "Plan the lifts of a measured yard again, for another magnet or order",
    "explain": "Explain why a lift is offered or refused: every check, and a picture of the place",
    "labels": "Read the codes on the bundles' labels of a measured yard",
    "compare": "Compare two measured yards: bundles that moved, settled, went and came",
    "store": "Keep the yard over time in a database, where bundles keep their names",
    "yard": "Print the yard as the store knows it, now or at an earlier time",
    "fleet": "Measure an archive again on Dask, compare two versions, promote one",
    "serve": "Serve the operator's page and its API",
    "plant": "Serve lifts to the plant by telegram, OPC UA, MQTT, S7 or webhooks, and check the links",
    "view": "Show a measured yard in 3D in the browser",
    "info": "Describe a recording: sensors, rates, gaps, calibration",
    "convert": "Convert a recording to another format (EuRoC folder, ROS bags)",
    "disparity": "Match one stereo pair",
    "bench": "Run benchmarks: stereo, matching, yards, bundles, lifts, worlds, live, time",
    "paper": "Reproduce the paper: every equation, figure and table beside ours, on one page",
    "commission": "Commission a rig step by step, from board pictures to the certificate",
    "accept": "Accept a rig by artefacts, with a certificate; or plan the artefacts",
    "verify": "Verify a rig in service by control charts, with alarms",
    "budget": "Break the uncertainty of a bundle's lift down into its sources",
    "calibrate": "Calibrate cameras, IMU, yard frame and magnet, and check for drift, with a verdict",
    "odometry": "Estimate the trajectory, and compare it with the truth if there is one",
    "simulate": "Render a recording of a yard with exact truth",
    "score": "Compare a measured yard with the truth of its recording",
    "export": "Write a measured cloud or map as PLY, PCD, LAS, LAZ, E57, GeoTIFF or CSV",
    "report": "Write the report of a measured yard again",
}
GROUPS = ("bench", "calibrate", "live", "store", "fleet", "plant")
"""Commands that are packages, in which `command.py` dispatches on the second word."""
SECOND = {"live": ("check", "soak")}
"""Second words of commands that also work without one."""
ROOMS = {
    "bench": ("paper",),
    "yard": ("lifts", "explain", "labels", "compare", "view", "report", "export"),
    "store": ("yard", "serve"),
    "acceptance": ("accept", "budget", "verify", "commission"),
}
"""Commands without a second word whose modules are in a package of related commands."""
INTERRUPTED = 130
_interrupts: list[int] = []
"""Signals that have interrupted this run."""
_AGAIN_S = 20.0
"""Time in seconds that a run has to clean up before it is interrupted again."""
_AT_ONCE_S = 0.001
"""Time in seconds until an interrupt that was lost is raised again."""


def home(name: str) -> str:
    """Return the module that runs a command."""
    room = next((f"{room}." for room, names in ROOMS.items() if name in names), "")
    return f"barsight.cli.{room}{name}" + (".command" if name in GROUPS else "")


def main() -> None:
    """Run the console script; signals end a run in the same way as Ctrl-C."""
    _fill_closed_streams()
    bound_heap()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    hangup = getattr(signal, "SIGHUP", None)  # Windows has none, nohup ignores it
    if hangup is not None and signal.getsignal(hangup) == signal.SIG_DFL:
        signal.signal(hangup, _interrupt)
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # libraries' notes to programmers would clutter the one-line error
    sys.unraisablehook = _unraisable
    code = run_and_print(sys.argv[1:])
    if code == INTERRUPTED:
        _leave_at_once(code)
    sys.exit(code)


def _fill_closed_streams() -> None:
    """Replace closed standard streams with the null device. Otherwise the next file opened would take the
    stream's number and receive the printed output.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            os.dup2(null, number)
            if null != number:
                os.close(null)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w"))


def run_and_print(arguments: Sequence[str]) -> int:
    """Run a command and flush standard output, which may fail if its reader is gone or its disk is full."""
    try:
        try:
            code = run(arguments)
        except SystemExit as leaving:  # from tyro, after its help or an error
            code = leaving.code if isinstance(leaving.code, int) else 1
        sys.stdout.flush()
    except OSError as error:
        # Output that can't be written must not be tried again when the interpreter exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _exit_code(error)
    return code


def run(arguments: Sequence[str]) -> int:
    """Run one command and return the exit code: 0 success, 1-5 a user's mistake, 130 interrupted."""
    if not arguments or arguments[0] in ("-h", "--help"):
        _print_help()
        return 0 if arguments else 2
    if arguments[0] in ("-V", "--version"):
        sys.stdout.write(f"barsight {barsight.__version__}\n")
        return 0
    name, rest = arguments[0], list(arguments[1:])
    if name not in COMMANDS:
        return _refuse(f"there is no command {name!r}; barsight --help lists them", 2)
    _interrupts.clear()
    # Files that OpenCV and tifffile can't decode are reported in the one-line error.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    logging.getLogger("tifffile").addHandler(logging.NullHandler())
    try:
        importlib.import_module(home(name)).run(rest)
    except KeyboardInterrupt:
        return _interrupted()
    except Exception as error:
        # A library that is being loaded may turn an interrupt into another error.
        if _interrupts:
            return _interrupted()
        return _exit_code(error)
    return 0


def _exit_code(error: Exception) -> int:
    """Print a user's mistake or a system error as one line; raise anything else again."""
    if isinstance(error, BarsightError):
        return _refuse(str(error), error.exit_code)
    if isinstance(error, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    if isinstance(error, OSError) and error.errno is not None:
        what = "reading or writing failed" if error.filename is None else _short(str(error.filename))
        return _refuse(f"{what}: {os.strerror(error.errno).lower()}", 1)
    if isinstance(error, MemoryError):
        return _refuse("the memory doesn't suffice: end other programs, or give a smaller input", 1)
    raise error


def _interrupt(number: int, frame: FrameType | None) -> None:
    for again in (signal.SIGINT, signal.SIGTERM):
        signal.signal(again, signal.SIG_IGN)  # a second signal must not cut the clean-up short
    _interrupts.append(number)
    _interrupt_after(_AGAIN_S)  # a library may swallow this exception
    raise KeyboardInterrupt


def _interrupt_again(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _interrupt_after(seconds: float) -> None:
    """Raise the interrupt again if the run still continues by then."""
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, _interrupt_again)
        signal.setitimer(signal.ITIMER_REAL, seconds)


def _unraisable(lost: sys.UnraisableHookArgs) -> None:
    """Raise an interrupt again that fell into a finalizer, from which Python lets no exception out."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        _interrupt_after(_AT_ONCE_S)
    else:
        sys.__unraisablehook__(lost)


def _leave_at_once(code: int) -> None:
    """Exit without the interpreter's own shutdown, which an interrupted import can turn into a crash.

    A C library whose loading was cut short frees its memory twice. Python also ends by SIGINT instead of the
    exit code if the interrupt came inside `exec` of a string, which dataclasses and namedtuples use.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # closed by the reader
            stream.flush()
    os._exit(code)


def _interrupted() -> int:
    """Print that a run was interrupted."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0)
    return _refuse("interrupted; nothing half-written is left", INTERRUPTED)


def _refuse(line: str, code: int) -> int:
    sys.stderr.write(f"barsight: {' '.join(printable(line).split())}\n")
    return code


def _short(path: str) -> str:
    return path if len(path) <= 300 else f"{path[:100]} ... {path[-100:]}"


def _print_help() -> None:
    lines = "\n".join(f"  {name:<11}{summary}" for name, summary in COMMANDS.items())
    sys.stdout.write(
        f"barsight {barsight.__version__}: measure a yard of steel bars from a travelling crane\n\n"
        f"usage: barsight COMMAND ...\n\ncommands:\n{lines}\n\n"
        "barsight COMMAND --help explains a command and all its settings.\n"
    )
