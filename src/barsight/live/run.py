"""Run `barsight live`: supervise until the recording or the crane's run ends, then measure the pairs kept."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from barsight.core.compiling.ahead import compile_ahead, load_kernels
from barsight.core.errors import ConfigError, InputError, MeasurementError, OutputError
from barsight.core.files import expect_empty, lies_within, translated_os_errors
from barsight.core.json_values import write_json
from barsight.core.memory import trim_heap
from barsight.core.notices import Notice
from barsight.core.parallel import in_background
from barsight.core.reading.sealed_json import read_sealed, write_sealed
from barsight.core.stamps import NS_PER_S
from barsight.core.timing import ProgressCallback
from barsight.live.latency import latencies
from barsight.live.link import GrowingRecording, KeptRecording, Link, LiveInput
from barsight.live.mapper import LIVE_MAP
from barsight.live.modes import Mode
from barsight.live.settings import LiveSettings
from barsight.live.shared.counters import Counters
from barsight.live.shared.ring import PairRing
from barsight.live.state import write_state
from barsight.live.supervisor import Supervisor
from barsight.live.survey import INTERRUPTED, STOOD
from barsight.measure_folder import ignore_progress, write_measured
from barsight.measure_settings import MeasureSettings
from barsight.pipeline.lift_choice import LiftRequest
from barsight.reconstruction.checkpoint import checkpoint_folder, checkpoint_key
from barsight.recording.base import Recording
from barsight.recording.open import open_recording
from barsight.recording.sensor_selection import SelectedSensors
from barsight.report.page import write_report
from barsight.yard.lifting.lift_file import read_lifts
from barsight.yard_frame import in_yard

MAX_SPEED = 1000.0
KEYFRAMES_VERSION = 2
WORK = ".live"
"""Folder of a run's intermediate data, in its output folder while it lasts."""
LATEST = ("pose.json", LIVE_MAP)
"""Files that hold the latest value during the run."""


@dataclass(frozen=True)
class Keyframes:
    """Pairs that a run kept (stamps, ns), and the mode at its end."""

    stamps_ns: tuple[int, ...]
    mode: Mode


def replay(
    path: Path, out: Path, settings: MeasureSettings, live: LiveSettings, *, speed: float = 1.0,
    magnet: Path | None = None, judged_at: Literal["now", "end"] = "now", keyframes: Path | None = None,
    tell: Callable[[str], None] = print, advance: ProgressCallback = ignore_progress,
) -> dict[str, Any]:  # fmt: skip
    """Measure a recording as if it came from the crane now, into `out`; return the content of result.json.

    speed: recorded seconds per second; 0: as fast as possible, without losses. keyframes: keyframes.json of
    an earlier run, to keep exactly the pairs it kept. tell: receives each line of the log. Raises a
    BarsightError.
    """
    given = None if keyframes is None else read_keyframes(keyframes)
    request = LiftRequest.of(magnet, judged_at)
    return begin_replay(path, out, settings, live, speed, tell).measure(given, request, advance)


def begin_replay(
    path: Path, out: Path, settings: MeasureSettings, live: LiveSettings, speed: float,
    tell: Callable[[str], None],
) -> LiveRun:  # fmt: skip
    """Begin the run of a replay into `out`; see `replay`."""
    if not (math.isfinite(speed) and 0 <= speed <= MAX_SPEED):
        raise ConfigError(f"speed must lie in 0...{MAX_SPEED:g} (0: as fast as possible), not {speed:g}")
    recording = open_recording(path, settings.recording)
    if lies_within(out, path):
        raise OutputError(f"{out}: lies in the recording itself; name a folder elsewhere")
    expect_empty(out)
    return LiveRun(recording, LiveInput(path.absolute(), speed), out, settings, live, tell)


class LiveRun:
    """A run into `out`. recording: what is known of its source beforehand. stop_because: why it ended
    early.
    """

    def __init__(
        self, recording: Recording, source: LiveInput, out: Path, settings: MeasureSettings,
        live: LiveSettings, tell: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._recording, self._source, self._out, self._asked = recording, source, out, settings
        self._live, self._tell = live, tell
        self.stop_because = ""

    def measure(
        self, given: Keyframes | None, request: LiftRequest, advance: ProgressCallback
    ) -> dict[str, Any]:
        """Run until the recording or the survey ends or a signal arrives, then measure the pairs kept.

        Returns an empty result if the crane only stood.
        """
        compile_ahead(advance, "measure")
        folder = self._out.absolute() / WORK
        with translated_os_errors(self._out):
            folder.mkdir(parents=True, exist_ok=True)
        camera = self._recording.rig.cam0
        board, ring = Counters(), PairRing(self._live.ring_pairs, camera.height, camera.width)
        supervisor: Supervisor | None = None
        try:
            link = Link(
                self._source, self._asked.chosen(), self._live, folder,
                checkpoint_folder(folder / "checkpoints", _key(self._recording, self._asked)), ring.name,
                board.name, None if given is None else given.stamps_ns,
            )  # fmt: skip
            supervisor = Supervisor(link, board, self._tell_all)
            with _stopped_by_signals(supervisor), in_background(lambda: load_kernels("measure")):
                supervisor.run()
            self.stop_because = supervisor.stop_because
            if self.stop_because == STOOD:
                return {}
            with ended_afterwards(self):
                supervisor.end_map()
                if supervisor.stop_because:
                    self._tell_all(f"ends early: {supervisor.stop_because}; what was kept is measured")
                if given is not None:
                    supervisor.state.mode = given.mode
                request, changed = request.read_again()
                if changed:
                    self._tell_all(changed)
                return _finish(supervisor, link, board, self._recording, self._asked, request, advance)
        except BaseException as error:
            if supervisor is None:
                raise
            supervisor.end_map(at_once=True)
            was_removed = not folder.exists()
            shutil.rmtree(folder, ignore_errors=True)  # leaves space for the state on a full disk
            supervisor.fail()
            if was_removed and isinstance(error, OSError):
                raise _removed(folder) from error
            raise
        finally:
            if supervisor is not None:
                supervisor.end_map(at_once=True)
            ring.remove()
            board.remove()
            shutil.rmtree(folder, ignore_errors=True)
            trim_heap()  # the command continues with the next survey

    def _tell_all(self, line: str) -> None:
        with (self._out / "live.log").open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        self._tell(line)


def _key(recording: Recording, settings: MeasureSettings) -> str:
    """Name the checkpoints as the measurement of the pairs kept will name them."""
    empty, chosen = KeptRecording(recording, []), settings.chosen()
    source = in_yard(SelectedSensors(empty, chosen.use), chosen.yard)
    return checkpoint_key(empty, source, chosen, source.digests())


def _finish(
    supervisor: Supervisor, link: Link, board: Counters, recording: Recording, settings: MeasureSettings,
    request: LiftRequest, advance: ProgressCallback,
) -> dict[str, Any]:  # fmt: skip
    """Measure the pairs kept, reusing the poses and disparities computed during the run."""
    state, out = supervisor.state, link.folder.parent
    frames = link.frames().read()
    kept = [stamp for stamp, _, _, is_kept, _ in frames if is_kept]
    for name in LATEST:
        (out / name).unlink(missing_ok=True)
    state.phase = "finishing"
    write_state(state, board, out)
    lifts_s = None
    try:
        if not kept and board["track", "kept"]:
            raise _removed(link.folder)
        if not kept:
            why = supervisor.stop_because or "; ".join(state.mode.reasons)
            raise MeasurementError(f"{link.source.recording}: no pair was kept; {why}")
        if link.source.crane is not None:
            recording, link = _recorded(link, kept, settings)
        write_keyframes(Keyframes(tuple(kept), state.mode), out / "keyframes.json")
        if not state.mode.lifts:
            forbidden = Notice("live-state", _why_no_lifts(state.mode))
            request = replace(request, notices=(*request.notices, forbidden))
        content = write_measured(
            [KeptRecording(recording, kept)], out, settings, request, advance=advance, overwrite=True,
            keep=link.checkpoints.parent, report=False,
        )  # fmt: skip
        lifts_s = (time.monotonic_ns() - frames[-1][1]) / NS_PER_S
        state.phase, state.offered = "done", len(read_lifts(out / "lifts.json")["lifts"])
        write_state(state, board, out)
        write_report(out, out / "report.html")
        return content
    finally:
        state.phase = "done" if lifts_s is not None else "failed"
        write_json(out / "latency.json", latencies(link, board, lifts_s))
        write_state(state, board, out)


def _removed(folder: Path) -> OutputError:
    return OutputError(f"{folder}: was removed during the run; survey again, and leave it alone")


def _recorded(link: Link, kept: list[int], settings: MeasureSettings) -> tuple[Recording, Link]:
    """Open the recording of a run at a crane, with the results already computed on it, if they still count:
    the yard file may have been changed during the run.

    If the recorder had to stop, the run's own logs replace the recording.
    """
    recording: Recording = open_recording(link.source.recording, settings.recording)
    if set(kept) - set(recording.index.stamps_ns):
        growing = GrowingRecording(recording, kept, link)
        growing.grow()
        recording = growing
    if link.checkpoints.name != _key(link.open_recording(), settings)[:32]:
        return recording, link
    folder = link.checkpoints.with_name(_key(recording, settings)[:32])
    return recording, replace(link, checkpoints=link.checkpoints.rename(folder))


def _why_no_lifts(mode: Mode) -> str:
    return f"the run ended in mode {mode.name}: {'; '.join(mode.reasons)}"


def _stopped_by_signals(supervisor: Supervisor) -> contextlib.AbstractContextManager[None]:
    """Let Ctrl-C and SIGTERM end the run, so that the pairs kept are measured; a second one ends that as
    well. SIGUSR1 ends the survey.
    """
    ends = {signal.SIGINT: INTERRUPTED, signal.SIGTERM: INTERRUPTED, signal.SIGUSR1: "told to end the survey"}
    return handled_signals(ends, supervisor.stop)


@contextlib.contextmanager
def ended_afterwards(run: LiveRun) -> Iterator[None]:
    """Hold back the first Ctrl-C or SIGTERM until the pairs kept are measured; the next one ends the run."""

    def note(because: str) -> None:
        run.stop_because = because
        os.write(2, b"what was kept is measured; a second signal ends that too\n")  # print may be running
        handled.close()

    with contextlib.ExitStack() as handled:
        if run.stop_because != INTERRUPTED:
            both = {signal.SIGINT: INTERRUPTED, signal.SIGTERM: INTERRUPTED}
            handled.enter_context(handled_signals(both, note))
        yield


@contextlib.contextmanager
def handled_signals(told: Mapping[signal.Signals, str], take: Callable[[str], object]) -> Iterator[None]:
    """Call `take` with each signal's text; threads other than the main one leave signals alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {
        number: signal.signal(number, lambda *_, what=what: take(what)) for number, what in told.items()
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def write_keyframes(keyframes: Keyframes, target: Path) -> None:
    """Write keyframes.json."""
    content = {
        "schema_version": KEYFRAMES_VERSION,
        "keyframes_ns": list(keyframes.stamps_ns),
        "mode": {
            "name": keyframes.mode.name,
            "reasons": list(keyframes.mode.reasons),
            "lifts": keyframes.mode.lifts,
        },
    }
    write_sealed(content, target)


def read_keyframes(path: Path) -> Keyframes:
    """Read keyframes.json, whose mode decides on lifts. Raises InputError if the file isn't one or was
    changed.
    """
    remedy = "give keyframes.json of a folder that barsight live wrote"
    content = read_sealed(path, KEYFRAMES_VERSION, remedy)
    try:
        mode = content["mode"]
        return Keyframes(
            tuple(map(int, content["keyframes_ns"])),
            Mode(mode["name"], tuple(mode["reasons"]), mode["lifts"] is True),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            path, f"is not a list of keyframes ({type(error).__name__}: {error})", remedy
        ) from error
