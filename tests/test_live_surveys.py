"""A survey begins as the crane moves and ends as it stops; folders are kept and dropped."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import barsight as bs
from barsight.core.settings.values import build_settings
from barsight.live.crane import run as crane_run
from barsight.live.crane.run import _drop_standing, _keep, _tidy, replay_surveys
from barsight.live.drift import DAY_NS, HEAD, NAMES, drift_figures, note_drift
from barsight.live.link import Link, LiveInput
from barsight.live.run import _stopped_by_signals, ended_afterwards
from barsight.live.settings import LiveSettings, SurveySettings
from barsight.live.shared.counters import Counters
from barsight.live.supervisor import Supervisor
from barsight.live.survey import INTERRUPTED, STOOD, SurveyWatch
from barsight.measure_folder import write_measured
from barsight.pipeline.lift_choice import LiftRequest
from barsight.recording.writers.retention import PROTECTED
from barsight.yard.events import YardEvent, kept_events, write_events

SETTINGS = SurveySettings(way_m=0.5, stop_s=2.0, rest_s=30.0, max_s=100.0)


def ends(
    x_m: np.ndarray, settings: SurveySettings = SETTINGS, *, is_alone: bool = False, silent_s: float = np.inf
) -> tuple[float, str] | None:
    """Tell when (s) and why it ends where the bridge goes so, ten readings a second; none from silent_s."""
    watch, begin_ns = SurveyWatch(settings, is_alone=is_alone), 1_700_000_000 * 10**9
    rng = np.random.default_rng(0)
    for k, x in enumerate(x_m):
        place = np.array([[x, 2.0, 8.0]]) + rng.normal(0, 0.003, (1, 3))
        because = watch.judge(begin_ns + k * 10**8, place if k < 10 * silent_s else place[:0])
        if because:
            return k / 10, because
    return None


def test_a_survey_ends_as_the_crane_stops() -> None:
    way = np.concatenate([np.zeros(250), 0.03 * np.arange(100), np.full(100, 3.0)])
    found = ends(way)
    assert found is not None and found[1] == "the crane stopped" and 36.4 < found[0] < 37.2
    turning = np.concatenate([way[:350], way[340:250:-1], np.zeros(100)])
    found = ends(turning)
    assert found is not None and found[0] > 45
    assert ends(way, is_alone=True) is None
    assert ends(way, silent_s=36.0) is None, "encoders that are out don't end it"


@pytest.mark.parametrize("is_alone", [False, True])
def test_a_crane_that_stands_or_never_stops_ends_it_too(is_alone: bool) -> None:
    stood = ends(np.full(2000, 1.0), is_alone=is_alone)
    assert stood == ((100.0, "a survey takes 100 s at most") if is_alone else (30.0, STOOD))
    nudged = np.full(2000, 1.0)
    nudged[50:] = 1.3
    assert ends(nudged, is_alone=is_alone) == stood
    going = ends(0.05 * np.arange(2000), is_alone=is_alone)
    assert going == (100.0, "a survey takes 100 s at most")
    longer = ends(0.05 * np.arange(2000), replace(SETTINGS, max_s=150.0), is_alone=is_alone)
    assert longer is not None and longer[0] == 150.0


def test_signals_end_a_survey_or_the_run() -> None:
    class Heard:
        """A supervisor as `_stopped_by_signals` takes it."""

        because = ""

        def stop(self, because: str) -> None:
            self.because = because

    before = signal.getsignal(signal.SIGUSR1)
    for number, told in ((signal.SIGUSR1, "told to end the survey"), (signal.SIGTERM, INTERRUPTED)):
        heard = Heard()
        with _stopped_by_signals(heard):  # type: ignore[arg-type]
            os.kill(os.getpid(), number)
            time.sleep(0.01)
        assert heard.because == told
    assert signal.getsignal(signal.SIGUSR1) == before


def test_a_signal_that_ends_surveys_ends_no_command_that_measures_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Measuring:
        """A run whose survey is over."""

        stop_because = INTERRUPTED

        def measure(self, *_: object) -> None:
            held.append(signal.getsignal(signal.SIGUSR1))

    held: list[object] = []
    monkeypatch.setattr(crane_run, "begin_replay", lambda *_: Measuring())
    replay_surveys(tmp_path, tmp_path / "out", bs.MeasureSettings(), LiveSettings(), tell=lambda _: None)
    assert callable(held[0]) and signal.getsignal(signal.SIGUSR1) == signal.SIG_DFL


def test_what_was_lifted_while_a_survey_ran_counts_for_it(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is reported in the folder of the survey before, whose lift it was."""
    settings = build_settings({"stereo": {"method": "sgbm"}, "map": {"cell_m": 0.05}}, bs.MeasureSettings)
    recording = bs.open_recording(whole)
    lifted = YardEvent(int(recording.index.stamps_ns[0]) + 1, "lift", 0.5, 0.0, 0.0, 7.0, 0.3)
    out = tmp_path / "out"
    before = out / "20260101T000000"
    before.mkdir(parents=True)

    class Measuring:
        """A run whose survey is measured while a lift is reported."""

        stop_because = INTERRUPTED

        def __init__(self, folder: Path) -> None:
            self.folder = folder

        def measure(self, _: object, request: LiftRequest, advance: object) -> None:
            write_events([lifted], before / "events.csv")
            write_measured([recording], self.folder, settings, request, overwrite=True, report=False)

    monkeypatch.setattr(crane_run, "_begin", lambda _, folder, *__, **___: Measuring(folder))
    monkeypatch.setattr(crane_run, "note_drift", lambda *_: "")
    monkeypatch.setattr(crane_run, "open_recording", lambda *_: recording)
    crane: Any = SimpleNamespace(
        encoders=1, recorder=SimpleNamespace(folder=None), survey=SimpleNamespace(keep=5)
    )
    crane_run.measure_surveys(crane, out, settings, LiveSettings(), tell=lambda _: None)
    assert kept_events((out / "latest").resolve()) == (lifted,)


@pytest.mark.parametrize("ended", ["the crane stopped", STOOD])
def test_an_interruption_counts_though_the_survey_was_ending(ended: str, whole: Path, tmp_path: Path) -> None:
    """While processes end and the recorder writes what is left: else the next survey would begin."""
    board, settings = Counters(), bs.MeasureSettings().chosen()
    try:
        link = Link(LiveInput(whole), settings, LiveSettings(), tmp_path, tmp_path, "", board.name, None)
        supervisor = Supervisor(link, board, print)
        supervisor.stop(ended)
        supervisor.stop("told to end the survey")
        assert supervisor.stop_because == ended
        with _stopped_by_signals(supervisor):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)
        assert supervisor.stop_because == INTERRUPTED
    finally:
        board.remove()


def test_the_first_signal_waits_until_a_survey_is_measured(tmp_path: Path) -> None:
    """So that `systemctl stop` loses none; the second one ends the measuring too."""

    def end(number: int, _: object) -> None:
        raise KeyboardInterrupt(number)

    run = SimpleNamespace(stop_because="told to end the survey")
    before = signal.signal(signal.SIGTERM, end)
    try:
        with ended_afterwards(run):  # type: ignore[arg-type]
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)
            assert run.stop_because == INTERRUPTED
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(0.01)
        with pytest.raises(KeyboardInterrupt), ended_afterwards(run):  # type: ignore[arg-type]
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)
    finally:
        signal.signal(signal.SIGTERM, before)


HOLDER = """
import multiprocessing, time
from barsight.live.shared.processes import end_with_parent

def hold():
    end_with_parent()
    time.sleep(60)

if __name__ == "__main__":
    process = multiprocessing.get_context("forkserver").Process(target=hold)
    process.start()
    print(process.pid, flush=True)
    time.sleep(60)
"""


def test_no_process_outlives_a_command_that_was_killed_at_once(tmp_path: Path) -> None:
    """Nobody would stop it, and it would hold cameras and ports."""
    script = tmp_path / "holder.py"
    script.write_text(HOLDER, encoding="utf-8")
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as command:
        assert command.stdout is not None
        held = Path("/proc") / command.stdout.readline().strip()
        time.sleep(1.0)
        assert (held / "stat").is_file()
        command.kill()
    give_up = time.monotonic() + 60
    while held.is_dir() and (held / "stat").read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < give_up
        time.sleep(0.05)


STARTER = """
import multiprocessing, signal, time
from barsight.live.shared.counters import Counters
from barsight.live.shared.processes import signals_blocked
if __name__ == "__main__":
    got = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: got.append(_[0]))
    board, context = Counters(), multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["barsight.live.supervisor"])
    process = context.Process(target=time.sleep, args=(0.1,))
    print("now", flush=True)
    with signals_blocked():
        process.start()
    process.join()
    board.remove()
    print(process.exitcode, sorted(got), flush=True)
"""


def test_signals_to_all_processes_while_the_first_one_starts_end_none_of_them(tmp_path: Path) -> None:
    """Ctrl-C in a terminal: the server of processes had printed a traceback, and the command another."""
    script = tmp_path / "starter.py"
    script.write_text(STARTER, encoding="utf-8")
    with subprocess.Popen(
        [sys.executable, script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as command:
        assert command.stdout is not None and command.stderr is not None
        assert command.stdout.readline() == "now\n"
        for number in (signal.SIGINT, signal.SIGTERM):
            time.sleep(0.4)
            os.killpg(command.pid, number)
        assert command.stdout.readline() == "0 [2, 15]\n"
        assert command.stderr.read() == ""


def test_what_a_killed_run_was_working_on_is_removed_but_not_its_recording(tmp_path: Path) -> None:
    killed = tmp_path / "20261130T122950"
    for name in (".live", "recording"):
        (killed / name).mkdir(parents=True)
        (killed / name / "data").touch()
    _tidy(tmp_path)
    assert [path.name for path in killed.iterdir()] == ["recording"]
    _tidy(tmp_path / "none yet")


def test_the_oldest_surveys_go_but_for_protected_ones(tmp_path: Path) -> None:
    for day in range(1, 6):
        (tmp_path / f"2026110{day}T101010").mkdir()
    (tmp_path / "20261101T101010" / PROTECTED).touch()
    (tmp_path / "notes").mkdir()
    (tmp_path / "latest").symlink_to("20261103T101010")
    _keep(tmp_path, 1, "20261105T101010")
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == ["20261101T101010", "20261103T101010", "20261105T101010", "latest", "notes"]


def test_surveys_dated_ahead_go_before_those_made_since_the_clock_was_set_right(tmp_path: Path) -> None:
    for name in ("20990101T000000", "20990102T000000", "20200101T000000", "20200102T000000"):
        (tmp_path / name).mkdir()
    _keep(tmp_path, 2, "20200102T000000")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["20200101T000000", "20200102T000000"]


def test_the_newest_survey_stays_though_the_clock_was_two_hours_ahead(tmp_path: Path) -> None:
    for name in ("20261105T080000", "20261105T120000", "20261105T121000", "20261105T101000"):
        (tmp_path / name).mkdir()
    _keep(tmp_path, 2, "20261105T101000")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["20261105T080000", "20261105T101000"]


def test_what_was_recorded_of_a_standing_crane_goes_unless_it_holds_an_alarm(tmp_path: Path) -> None:
    here, recording = tmp_path / "survey", tmp_path / "elsewhere"
    for path in (here, recording / "alarms"):
        path.mkdir(parents=True)
    (recording / "alarms" / "segment_000000.mcap").touch()
    _drop_standing(here, recording)
    assert here.is_dir() and recording.is_dir()
    (recording / "alarms" / "segment_000000.mcap").unlink()
    _drop_standing(here, recording)
    assert not here.exists() and not recording.exists()


def test_the_drift_of_surveys_has_a_trend(whole: Path, tmp_path: Path) -> None:
    """Two surveys of one calibration; then days of which the roll grows by 2e-5 rad, one of them wrong."""
    path = tmp_path / "drift.csv"
    assert drift_figures(path) == {}
    recording = bs.open_recording(whole)
    for _ in range(2):
        assert note_drift(recording, path) == ""
    figures = drift_figures(path)
    assert set(figures) == {f"{name}{end}" for name in NAMES for end in ("", "_sigma")}
    assert all(abs(figures[name]) < 4 * figures[f"{name}_sigma"] for name in NAMES)
    rng, lines = np.random.default_rng(2), [HEAD]
    for day in range(30):
        values = rng.normal(0, 1e-5, 3)
        values[1] += 2e-5 * day + (day == 7) * 1e-2
        both = ",".join(f"{value:.5g},1e-05" for value in values)
        lines.append(f"{1_700_000_000_000_000_000 + day * DAY_NS},{both}\n")
    path.write_text("".join(lines) + "17000,0.1")
    figures = drift_figures(path)
    assert figures["roll_rad_per_day"] == pytest.approx(2e-5, abs=1e-6)
    assert abs(figures["pitch_rad_per_day"]) < 1e-6
