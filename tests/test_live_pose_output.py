"""The pose process: what of the sensors it takes, and when."""

import json
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import barsight as bs
from barsight.core.arrays import Float64, Int64
from barsight.core.stamps import NS_PER_S
from barsight.live.link import Link, LiveInput
from barsight.live.pose_output import PoseOutput, output_poses
from barsight.live.settings import LiveSettings
from barsight.live.shared.counters import Counters
from barsight.motion.fixed_lag.propagation import ROW_NUMBERS, NavigationState

BEGIN_NS = 1_700_000_000_000_000_000
STAMPS = BEGIN_NS + np.arange(-60, 13) * 50_000_000
SPEED_MPS = 0.5


def way(stamps: Int64) -> Float64:
    """Readings of a crane that goes along x."""
    noise = np.random.default_rng(3).normal(0, 5e-4, (len(stamps), 3))
    noise[:, 0] += SPEED_MPS * (stamps - BEGIN_NS) / 1e9
    return noise


def linked(whole: Path, tmp_path: Path, yard: Path | None = None, max_predicted_s: float = 2.0) -> Link:
    """A run whose only state, at `BEGIN_NS`, knows the place well and the speed badly."""
    folder = tmp_path / ".live"
    folder.mkdir(parents=True)
    settings = replace(bs.MeasureSettings(), yard=yard).chosen()
    live = LiveSettings(max_predicted_s=max_predicted_s)
    link = Link(LiveInput(whole), settings, live, folder, folder, "", "", None)
    state = NavigationState.of(BEGIN_NS, np.zeros(ROW_NUMBERS))
    covariance = np.eye(15) * 1e-6
    covariance[6:9, 6:9] = np.eye(3)
    body = replace(state.body, rotation=np.eye(3), velocity_mps=np.array([SPEED_MPS, 0.0, 0.0]))
    state = replace(state, target="yard", body=body, covariance=covariance)
    link.states().append(np.array([state.stamp_ns]), state.row[None])
    return link


def give_imu(link: Link, until_s: float) -> None:
    last, _ = link.readings("imu").last(1)
    stamps = np.arange(last[0] if len(last) else BEGIN_NS, BEGIN_NS + round(1e9 * until_s), 10_000_000)[1:]
    link.readings("imu").append(stamps, np.tile([0, 0, 0, 0, 0, 9.80665], (len(stamps), 1)))


def written(output: PoseOutput, link: Link, after_s: float) -> dict[str, Any]:
    assert output.write(BEGIN_NS + round(1e9 * after_s) - link.open_recording().rig.timeshift_cam_imu_ns)
    told: dict[str, Any] = json.loads((link.folder.parent / "pose.json").read_text(encoding="utf-8"))
    return told


def test_encoders_that_come_later_than_the_imu_are_taken(whole: Path, tmp_path: Path) -> None:
    link = linked(whole, tmp_path)
    output, places, come = PoseOutput(link), way(STAMPS), BEGIN_NS + 50_000_000
    link.readings("crane").append(STAMPS[come >= STAMPS], places[come >= STAMPS])
    give_imu(link, 0.5)
    before = written(output, link, 0.48)
    now = (come < STAMPS) & (BEGIN_NS + 450_000_000 >= STAMPS)
    link.readings("crane").append(STAMPS[now], places[now])
    give_imu(link, 0.55)
    after = written(output, link, 0.52)
    assert after["sigma_m"][0] < before["sigma_m"][0] / 3
    assert after["position_m"][0] == pytest.approx(SPEED_MPS * 0.52, abs=0.005)
    assert after["predicted_s"] == pytest.approx(0.52)
    lever = bs.open_recording(whole).crane().crane_to_body_m
    assert np.array(after["position_m"]) - after["crane_m"] == pytest.approx(lever, abs=1e-6)


def test_frozen_encoders_hold_no_pose(whole: Path, tmp_path: Path) -> None:
    link = linked(whole, tmp_path)
    output, places = PoseOutput(link), way(STAMPS)
    frozen = STAMPS > BEGIN_NS - 400_000_000
    places[frozen] = places[np.argmax(frozen)]
    link.readings("crane").append(STAMPS, places)
    give_imu(link, 0.6)
    assert written(output, link, 0.5)["position_m"][0] == pytest.approx(SPEED_MPS * 0.5, abs=0.005)


def test_encoders_that_freeze_after_the_state_hold_no_pose(whole: Path, tmp_path: Path) -> None:
    """Without an IMU nothing but the encoders tells whether the crane stopped."""
    link = linked(whole, tmp_path)
    state = NavigationState.of(BEGIN_NS, link.states().last(1)[1][0])
    known = replace(state, covariance=np.eye(15) * 1e-6)
    link.states().append(np.array([BEGIN_NS]), known.row[None])
    output, places, last_ns = PoseOutput(link), way(STAMPS), 0
    frozen = STAMPS > BEGIN_NS + 100_000_000
    places[frozen] = places[np.argmax(frozen)]
    for tenth in range(1, 7):
        now_ns = BEGIN_NS + tenth * 100_000_000
        now = (last_ns < STAMPS) & (now_ns >= STAMPS)
        link.readings("crane").append(STAMPS[now], places[now])
        last_ns, told = now_ns, written(output, link, tenth / 10)
    error_m = abs(told["position_m"][0] - SPEED_MPS * 0.6)
    assert error_m < 3 * told["sigma_m"][0]


@pytest.mark.parametrize("has_imu", [False, True])
@pytest.mark.parametrize("jump_m", [0.06, 0.2])
def test_encoders_that_jump_after_the_state_hold_no_pose(
    jump_m: float, has_imu: bool, whole: Path, tmp_path: Path
) -> None:
    """Not at once, nor once its sigma has grown so far that the place they tell could be one."""
    link = linked(whole, tmp_path)
    state = NavigationState.of(BEGIN_NS, link.states().last(1)[1][0])
    known = replace(state, covariance=np.eye(15) * 1e-6)
    link.states().append(np.array([BEGIN_NS]), known.row[None])
    stamps = BEGIN_NS + np.arange(-60, 41) * 50_000_000
    output, places, last_ns = PoseOutput(link), way(stamps), 0
    places[stamps > BEGIN_NS + 200_000_000, 0] += jump_m
    for tenth in range(1, 19):
        now_ns = BEGIN_NS + tenth * 100_000_000
        now = (last_ns < stamps) & (stamps <= now_ns)
        link.readings("crane").append(stamps[now], places[now])
        if has_imu:
            give_imu(link, tenth / 10 + 0.05)
        last_ns, told = now_ns, written(output, link, tenth / 10)
        assert abs(told["position_m"][0] - SPEED_MPS * tenth / 10) < 3 * told["sigma_m"][0]


def test_a_state_that_comes_late_still_begins_with_its_readings(whole: Path, tmp_path: Path) -> None:
    """As late as `max_predicted_s` lets it: the encoders about it hold the pose then too."""
    link = linked(whole, tmp_path, max_predicted_s=15.0)
    output, last_ns, speed_mps = PoseOutput(link), 0, np.array([SPEED_MPS, 0.0, 0.0])
    stamps = BEGIN_NS + np.arange(-60, 301) * 50_000_000
    for second in range(1, 14):
        now = (stamps > last_ns) & (stamps <= BEGIN_NS + second * NS_PER_S)
        link.readings("crane").append(stamps[now], way(stamps)[now])
        give_imu(link, second)
        last_ns = BEGIN_NS + second * NS_PER_S
        written(output, link, second)
    late_ns = BEGIN_NS + NS_PER_S
    state = NavigationState.of(late_ns, link.states().last(1)[1][0])
    body = replace(state.body, position_m=speed_mps)
    link.states().append(np.array([late_ns]), replace(state, stamp_ns=late_ns, body=body).row[None])
    told = written(output, link, 13)
    assert told["predicted_s"] == pytest.approx(12)
    assert told["position_m"][0] == pytest.approx(SPEED_MPS * 13, abs=0.005)
    assert max(told["sigma_m"]) < 0.005


def test_a_process_that_writes_seldom_goes_on_and_ends_at_once(whole: Path, tmp_path: Path) -> None:
    """A pose every ten seconds: one that beat no more often would be ended for hanging."""
    board = Counters()
    link = linked(whole, tmp_path)
    link = replace(link, live=replace(link.live, pose_rate_hz=0.1), counters=board.name)
    board["supervisor", "began_ns"] = time.monotonic_ns()
    thread = threading.Thread(target=output_poses, args=(link,))
    try:
        thread.start()
        time.sleep(1.5)
        silent_s = (time.monotonic_ns() - board["pose", "beat_ns"]) / 1e9
        board["supervisor", "stop"] = 1
        thread.join(2.0)
        assert silent_s < 1.0 and not thread.is_alive()
    finally:
        thread.join(20.0)
        board.remove()


def test_the_sigma_has_the_yard_frames(whole: Path, tmp_path: Path) -> None:
    """A frame known to 20 mm and 0 rad beside none."""
    frame = {"barsight_yard": 1, "yard_from_encoders": np.eye(4).tolist()}
    covariance = np.diag([0.0, 0.0, 0.0, 4e-4, 4e-4, 4e-4]).tolist()
    yard, told = tmp_path / "yard.yaml", []
    yard.write_text(json.dumps({**frame, "covariance": covariance}))
    for name, file in (("bare", None), ("framed", yard)):
        link = linked(whole, tmp_path / name, file)
        link.readings("crane").append(STAMPS, way(STAMPS))
        give_imu(link, 0.5)
        told.append(written(PoseOutput(link), link, 0.48))
    assert told[1]["position_m"] == pytest.approx(told[0]["position_m"], abs=1e-6)
    wanted = np.hypot(told[0]["sigma_m"], 0.02)
    assert told[1]["sigma_m"] == pytest.approx(wanted, abs=1e-5)
