"""Run `barsight live --replay`: supervise until the recording ends, then measure what was kept."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from barsight.checkpoint import checkpoint_folder
from barsight.core.compiling.ahead import compile_ahead
from barsight.core.errors import ConfigError, InputError, MeasurementError, OutputError
from barsight.core.files import atomic_path, expect_empty, translated_os_errors
from barsight.core.notices import Notice
from barsight.core.stamps import NS_PER_S
from barsight.live.counters import Counters
from barsight.live.latency import latencies
from barsight.live.link import KeptRecording, Link
from barsight.live.mapper import LIVE_MAP
from barsight.live.modes import Mode
from barsight.live.ring import PairRing
from barsight.live.settings import LiveSettings
from barsight.live.state import write_state
from barsight.live.supervisor import Supervisor
from barsight.map_building import ProgressCallback, checkpoint_key
from barsight.measure_folder import ignore_progress, write_measured
from barsight.measure_settings import MeasureSettings
from barsight.measurement import to_json
from barsight.recording.open import open_recording
from barsight.recording.stored_images import StoredPictures
from barsight.yard.lifting.lift_file import read_lifts
from barsight.yard.magnet.description import Magnet, load_magnet

MAX_SPEED = 1000.0
LATEST = ("pose.json", LIVE_MAP)
"""Files that hold the latest value while the run lasts."""


@dataclass(frozen=True)
class Keyframes:
    """Pairs that a run kept (stamps, ns), and the mode that it ended in."""

    stamps_ns: tuple[int, ...]
    mode: Mode


def replay(
    path: Path, out: Path, settings: MeasureSettings, live: LiveSettings, *, speed: float = 1.0,
    magnet: Path | None = None, judged_at: Literal["now", "end"] = "now", keyframes: Path | None = None,
    tell: Callable[[str], None] = print, advance: ProgressCallback = ignore_progress,
) -> dict[str, Any]:  # fmt: skip
    """Measure a recording as if it came from the crane now, into `out`; return what result.json says.

    speed: recorded seconds a second; 0: as fast as possible, where nothing is lost. keyframes: keyframes.json
    of an earlier run, to keep just what it kept. tell: takes each line of the log. Raises a BarsightError.
    """
    if not (math.isfinite(speed) and 0 <= speed <= MAX_SPEED):
        raise ConfigError(f"speed must lie in 0...{MAX_SPEED:g} (0: as fast as possible), not {speed:g}")
    given = None if keyframes is None else read_keyframes(keyframes)
    described = None if magnet is None else load_magnet(magnet)
    recording = open_recording(path, settings.recording)
    if path.resolve() in (out.resolve(), *out.resolve().parents):
        raise OutputError(f"{out}: lies in the recording itself; name a folder elsewhere")
    expect_empty(out)
    compile_ahead(advance, "measure")
    chosen = settings.chosen()
    with translated_os_errors(out):
        folder = out / ".live"
        folder.mkdir(parents=True)
    log = out / "live.log"

    def tell_all(line: str) -> None:
        with log.open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        tell(line)

    key = checkpoint_key(
        KeptRecording(recording, []), to_json(asdict(chosen)), KeptRecording(recording, []).digests()
    )
    camera = recording.rig.cam0
    board, ring = Counters(), PairRing(live.ring_pairs, camera.height, camera.width)
    try:
        link = Link(
            path.absolute(), chosen, live, speed, folder.absolute(),
            checkpoint_folder(folder.absolute() / "checkpoints", key), ring.name, board.name,
            None if given is None else given.stamps_ns,
        )  # fmt: skip
        supervisor = Supervisor(link, board, tell_all)
        with _stopped_by_signals(supervisor):
            supervisor.run()
        if supervisor.stop_because:
            tell_all(f"ends early: {supervisor.stop_because}; what was kept is measured")
        if given is not None:
            supervisor.state.mode = given.mode
        return _finish(supervisor, link, board, recording, settings, described, judged_at, advance)
    finally:
        ring.remove()
        board.remove()
        shutil.rmtree(folder, ignore_errors=True)


def _finish(
    supervisor: Supervisor, link: Link, board: Counters, recording: StoredPictures, settings: MeasureSettings,
    magnet: Magnet | None, judged_at: Literal["now", "end"], advance: ProgressCallback,
) -> dict[str, Any]:  # fmt: skip
    """Measure what was kept, with the poses' and disparities' work that is done already."""
    state, out = supervisor.state, link.folder.parent
    frames = link.frames().read()
    kept = [stamp for stamp, _, _, is_kept, _ in frames if is_kept]
    for name in LATEST:
        (out / name).unlink(missing_ok=True)
    state.phase = "finishing"
    write_state(state, board, out)
    lifts_s = None
    try:
        if not kept:
            why = supervisor.stop_because or "; ".join(state.mode.reasons)
            raise MeasurementError(f"{link.recording}: no pair was kept; {why}")
        write_keyframes(Keyframes(tuple(kept), state.mode), out / "keyframes.json")
        forbidden = () if state.mode.lifts else (Notice("live-state", _why_no_lifts(state.mode)),)
        content = write_measured(
            [KeptRecording(recording, kept)], out, settings, advance=advance, overwrite=True,
            keep=link.checkpoints.parent, magnet=magnet, judged_at=judged_at, notices=forbidden,
        )  # fmt: skip
        lifts_s = (time.monotonic_ns() - frames[-1][1]) / NS_PER_S
        state.phase, state.offered = "done", len(read_lifts(out / "lifts.json")["lifts"])
        return content
    finally:
        state.phase = "done" if lifts_s is not None else "failed"
        with atomic_path(out / "latency.json") as path:
            path.write_text(json.dumps(latencies(link, board, lifts_s), indent=1) + "\n", encoding="utf-8")
        write_state(state, board, out)


def _why_no_lifts(mode: Mode) -> str:
    return f"the run ended in mode {mode.name}: {'; '.join(mode.reasons)}"


@contextlib.contextmanager
def _stopped_by_signals(supervisor: Supervisor) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the run, so that what was kept is measured; a second one ends that too."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: supervisor.stop("interrupted")) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def write_keyframes(keyframes: Keyframes, target: Path) -> None:
    """Write keyframes.json."""
    content = {
        "schema_version": 1,
        "keyframes_ns": list(keyframes.stamps_ns),
        "mode": {
            "name": keyframes.mode.name,
            "reasons": list(keyframes.mode.reasons),
            "lifts": keyframes.mode.lifts,
        },
    }
    with atomic_path(target) as path:
        path.write_text(json.dumps(content) + "\n", encoding="utf-8")


def read_keyframes(path: Path) -> Keyframes:
    """Read keyframes.json. Raises InputError where it is none."""
    remedy = "give keyframes.json of a folder that barsight live wrote"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        mode = content["mode"]
        return Keyframes(
            tuple(map(int, content["keyframes_ns"])),
            Mode(mode["name"], tuple(mode["reasons"]), bool(mode["lifts"])),
        )
    except FileNotFoundError as error:
        raise InputError(path, "no such file", remedy) from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            path, f"is no list of keyframes ({type(error).__name__}: {error})", remedy
        ) from error
