"""Run `barsight live`: one survey or many with the crane's own sensors, or a replay over and over."""

from __future__ import annotations

import shutil
import signal
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from barsight.core.errors import BarsightError, ConfigError
from barsight.core.files import expect_empty, held_folder, translated_os_errors
from barsight.core.timing import ProgressCallback
from barsight.live.crane.preflight import prove_sensors
from barsight.live.drift import DRIFT_FILE, note_drift
from barsight.live.link import LiveInput
from barsight.live.run import WORK, LiveRun, begin_replay, handled_signals
from barsight.live.settings import CraneConfig, LiveSettings
from barsight.live.survey import INTERRUPTED, STOOD
from barsight.measure_folder import ignore_progress
from barsight.measure_settings import MeasureSettings
from barsight.pipeline.lift_choice import LiftRequest
from barsight.recording.formats.segments import PATTERN
from barsight.recording.open import open_recording
from barsight.recording.writers.bag import write_descriptions
from barsight.recording.writers.retention import PROTECTED, oldest_first

STAMP = "%Y%m%dT%H%M%S"
AGAIN_S = 5.0
"""Interval in seconds at which the sensors are checked after a failed survey, until they answer."""
REPLAYS_KEPT = 5
"""Number of survey folders kept when a recording is replayed over and over."""
RUNNING, LATEST = "current", "latest"
"""Names of the links to the running survey and to the last one measured."""
_NO_SURVEY_RUNS = {one: "no survey runs" for one in signal.Signals if one.name == "SIGUSR1"}
"""Reply to the signal that ends a survey while one is being measured or none can begin: the signal must not
end the command. (Windows has no such signal.)
"""


@handled_signals(_NO_SURVEY_RUNS, lambda _: None)
def measure_crane(
    crane: CraneConfig, out: Path, settings: MeasureSettings, live: LiveSettings, *,
    magnet: Path | None = None, tell: Callable[[str], None] = print,
    advance: ProgressCallback = ignore_progress,
) -> dict[str, Any]:  # fmt: skip
    """Measure one survey into `out`, until Ctrl-C or SIGTERM; return the content of result.json.

    All sensors are checked first; nothing is written if one of them isn't as crane.toml describes it.
    Raises a BarsightError.
    """
    request = LiftRequest.of(magnet)
    expect_empty(out)
    recording = _recorded(crane, out, datetime.now(UTC).strftime(STAMP))
    run = _begin(crane, out, recording, settings, live, tell)
    with held_folder(recording):  # from other runs' retention
        return run.measure(None, request, advance)


@handled_signals(_NO_SURVEY_RUNS, lambda _: None)
def measure_surveys(
    crane: CraneConfig, out: Path, settings: MeasureSettings, live: LiveSettings, *,
    magnet: Path | None = None, tell: Callable[[str], None] = print,
    advance: ProgressCallback = ignore_progress,
) -> dict[str, Any]:  # fmt: skip
    """Measure survey after survey, each into its own folder in `out`, until Ctrl-C or SIGTERM.

    Events in any folder count for a survey that had begun. A failed survey is reported, and the next one
    begins once all sensors answer. Returns an empty result, as each folder has its own. Raises a
    BarsightError if the sensors don't answer at the start.
    """
    if crane.encoders is None:
        raise ConfigError("crane.toml has no [encoders], by which surveys begin and end")
    proved, ended, is_first = False, "", True
    _tidy(out)
    while ended != INTERRUPTED:
        folder = out / datetime.now(UTC).strftime(STAMP)
        recording = _recorded(crane, folder, folder.name)
        try:
            request = LiftRequest.of(magnet, surveys=out)
            run = _begin(crane, folder, recording, settings, live, tell, surveys=True, proved=proved)
        except BarsightError as error:
            if is_first:
                raise
            tell(f"no survey can begin: {error}")
            time.sleep(AGAIN_S)
            continue
        is_first, proved = False, True
        _point(out / RUNNING, folder.name)
        try:
            with held_folder(recording):
                run.measure(None, request, advance)
            ended = run.stop_because
            if ended == STOOD:
                _drop_standing(folder, recording)
            else:
                _point(out / LATEST, folder.name)
                tell(f"{folder.name} is measured")
                if why := note_drift(open_recording(recording, settings.recording), out / DRIFT_FILE):
                    tell(f"{folder.name} says nothing of the calibration: {why}")
        except BarsightError as error:
            ended, proved = run.stop_because, False
            tell(f"{folder.name} offers no lifts: {error}")
        _keep(out, crane.survey.keep, folder.name)
    return {}


@handled_signals(_NO_SURVEY_RUNS, lambda _: None)
def replay_surveys(
    path: Path, out: Path, settings: MeasureSettings, live: LiveSettings, *, speed: float = 1.0,
    magnet: Path | None = None, judged_at: Literal["now", "end"] = "now", tell: Callable[[str], None] = print,
    advance: ProgressCallback = ignore_progress,
) -> dict[str, Any]:  # fmt: skip
    """Measure a recording over and over, each time into a folder in `out`, until Ctrl-C or SIGTERM.

    The newest few folders are kept. Raises a BarsightError if the first run fails.
    """
    ended, is_first = "", True
    _tidy(out)
    while ended != INTERRUPTED:
        folder = out / datetime.now(UTC).strftime(STAMP)
        request = LiftRequest.of(magnet, judged_at)
        run = begin_replay(path, folder, settings, live, speed, tell)
        with translated_os_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        _point(out / RUNNING, folder.name)
        try:
            run.measure(None, request, advance)
            _point(out / LATEST, folder.name)
            tell(f"{folder.name} is measured")
        except BarsightError as error:
            if is_first:
                raise
            tell(f"{folder.name} offers no lifts: {error}")
        ended, is_first = run.stop_because, False
        _keep(out, REPLAYS_KEPT, folder.name)
    return {}


def _begin(
    crane: CraneConfig, out: Path, folder: Path, settings: MeasureSettings, live: LiveSettings,
    tell: Callable[[str], None], *, surveys: bool = False, proved: bool = False,
) -> LiveRun:  # fmt: skip
    """Check the sensors and create the folders of a run; it records into `folder`."""
    awaited = crane.described(folder)
    if not proved:
        prove_sensors(crane, awaited)
    with translated_os_errors(folder):
        out.mkdir(parents=True, exist_ok=True)
        folder.mkdir(parents=True)
        write_descriptions(awaited, folder)
    epoch_ns = time.time_ns() - time.monotonic_ns()
    source = LiveInput(folder, crane=crane, epoch_ns=epoch_ns, surveys=surveys)
    return LiveRun(crane.awaited(folder), source, out, settings, live, tell)


def _recorded(crane: CraneConfig, out: Path, name: str) -> Path:
    """Return the folder of a run's recording."""
    where = crane.recorder.folder
    return out.absolute() / "recording" if where is None else where / name


def _drop_standing(folder: Path, recording: Path) -> None:
    """Remove the folders of a run in which the crane only stood, except pictures around alarms."""
    if not any((recording / "alarms").glob(PATTERN)):
        for path in (recording, folder):
            shutil.rmtree(path, ignore_errors=True)


def _point(link: Path, name: str) -> None:
    """Create a link to a folder beside it, or redirect it, atomically."""
    fresh = link.with_name(f".{link.name}.new")
    with translated_os_errors(link):
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(name)
        fresh.replace(link)


def _tidy(out: Path) -> None:
    """Remove what killed runs left of their work; their recordings stay."""
    for path in _surveys(out):
        shutil.rmtree(path / WORK, ignore_errors=True)


def _keep(out: Path, count: int, newest: str) -> None:
    """Remove the oldest survey folders beyond `count`, except the last one measured.

    newest: name of the folder just written.
    """
    for path in oldest_first(_surveys(out), newest)[:-count]:
        is_latest = (out / LATEST).exists() and path.samefile(out / LATEST)
        if not is_latest and not (path / PROTECTED).exists():
            shutil.rmtree(path, ignore_errors=True)


def _surveys(out: Path) -> list[Path]:
    """List the survey folders in `out`."""
    return [
        path for path in (out.iterdir() if out.is_dir() else ())
        if path.is_dir() and not path.is_symlink() and len(path.name) == 15 and path.name[8] == "T"
    ]  # fmt: skip
