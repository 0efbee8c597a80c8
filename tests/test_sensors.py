"""Sensors at a crane: clocks, datagrams, pairs by trigger, retention, crane.toml."""

import shutil
import socket
import struct
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import barsight as bs
from barsight.cli.main import run as cli
from barsight.core.files import held_folder
from barsight.live.crane.check import check_machine
from barsight.live.crane.preflight import expect_plausible, held
from barsight.live.settings import read_crane
from barsight.recording.writers.retention import PROTECTED, Retention
from barsight.sensors import crane as crane_module
from barsight.sensors.camera import RawPicture
from barsight.sensors.clock import DeviceClock
from barsight.sensors.crane import CraneSource
from barsight.sensors.pairing import PairFormer
from barsight.sensors.receiver import RawReading, ReadingReceiver, Sequence
from barsight.sensors.settings import ReadingsSettings
from barsight.sensors.source import LivePicture, LostPicture, Readings
from reading_forms import pack

SECOND = 10**9
DARK = np.zeros((4, 6), np.uint8)


@pytest.mark.parametrize("seed", range(3))
def test_a_clock_is_mapped_by_its_least_delays(seed: int) -> None:
    """30 Hz for two minutes, -60 ppm, 7 s off; delays of 8 ms and more, one in twenty late by up to 0.3 s."""
    rng = np.random.default_rng(seed)
    clock, drift = DeviceClock(), -60e-6
    wrong = []
    for k in range(3600):
        true_ns = k * SECOND // 30
        delay_ns = 8e6 + rng.exponential(1e6) + (rng.uniform(0, 3e8) if rng.uniform() < 0.05 else 0)
        device_ns = round(7 * SECOND + true_ns * (1 + drift))
        if clock.add(device_ns, true_ns + round(delay_ns)):
            wrong.append(clock.host_ns(device_ns) - true_ns - 8e6)
    assert len(wrong) > 3500 and clock.jumps == 0
    assert max(map(abs, wrong)) < 1.5e6 and max(map(abs, wrong[600:])) < 0.4e6
    assert abs(clock.drift_ppb - 60_000) < 3_000 and 50e6 < clock.jitter_ns < 300e6


@pytest.mark.parametrize(("ppm", "is_wild"), [(150, False), (-150, False), (-300, True), (500, True)])
def test_a_clock_that_drifts_too_fast_to_be_followed_is_told(ppm: float, is_wild: bool) -> None:
    """One of -300 ppm had stamps 12 ms late, and nothing told so; a busy host is no such clock."""
    rng, clock, told = np.random.default_rng(0), DeviceClock(), []
    for k in range(20 * 180):
        true_ns = k * SECOND // 20
        late_ns = 1e6 + rng.exponential(1e6) + (rng.uniform(0, 8e7) if 30 < true_ns / SECOND < 90 else 0.0)
        clock.add(round(true_ns * (1 + ppm * 1e-6)), round(true_ns + late_ns))
        told.append(clock.is_wild)
    assert any(told[20 * 30 : 20 * 60]) is False
    assert all(told[20 * 100 :]) if is_wild else not any(told)


@pytest.mark.parametrize("ppm", [-1500, -20_000])
def test_a_clock_so_slow_that_it_jumps_again_and_again_is_told(ppm: float) -> None:
    """At -1500 ppm it counted as jumped every 40 s, so that 60 s never passed: 54 ms late, untold."""
    rng, clock, told = np.random.default_rng(0), DeviceClock(), []
    for k in range(20 * 300):
        true_ns = k * SECOND // 20
        slow_s = min(k / 20, 150.0)  # then it is right again
        device_ns = round(true_ns + slow_s * SECOND * ppm * 1e-6)
        clock.add(device_ns, round(true_ns + 1e6 + rng.exponential(1e6)))
        told.append(clock.is_wild)
    assert clock.jumps > 2 and all(told[20 * 45 : 20 * 150]) and not told[-1]


def test_a_clock_that_is_set_twice_is_not_one_that_drifts() -> None:
    clock = DeviceClock()
    for k in range(20 * 90):
        set_s = 0.0 if k < 300 else -0.4 if k < 900 else 0.3
        clock.add(round((k / 20 + set_s) * SECOND), round((k / 20 + 0.001) * SECOND))
        assert not clock.is_wild
    assert clock.jumps == 2


def test_a_clock_that_jumps_settles_anew() -> None:
    for jump_ns in (-20 * SECOND, 20 * SECOND):
        clock = DeviceClock()
        for k in range(300):
            true_ns = k * SECOND // 30
            device_ns = true_ns + 50 * SECOND + (jump_ns if k >= 150 else 0)
            settled = clock.add(device_ns, true_ns + 5_000_000)
            if 160 <= k < 170:
                assert not settled
        assert clock.jumps == 1 and settled
        assert abs(clock.host_ns(device_ns) - true_ns - 5_000_000) < 1000


@pytest.mark.parametrize("back_s", [0.1, 0.3, 0.9])
def test_a_clock_that_is_set_back_a_little_settles_anew_too(back_s: float) -> None:
    """Not after two minutes, when the last delays from before are forgotten; a busy host is no such clock."""
    clock, rng, off_s = DeviceClock(), np.random.default_rng(0), []
    for k in range(20 * 60):
        t = k / 20
        late_s = 0.001 + rng.exponential(0.001) + (0.08 if 10 < t < 12 else 0.0)
        device_ns = round((1000 + t - (back_s if t > 30 else 0.0)) * SECOND)
        clock.add(device_ns, round((t + late_s) * SECOND))
        off_s.append(clock.host_ns(device_ns) / SECOND - t)
    assert clock.jumps == 1
    assert np.abs(off_s[: 20 * 30]).max() < 0.005 and np.abs(off_s[20 * 35 :]).max() < 0.005


def test_a_camera_that_was_set_back_a_little_while_it_was_away_has_no_wrong_stamp() -> None:
    """cam0 of 10 Hz is lost for a second; meanwhile its clock is set back by 20 ms."""
    source = CraneSource((), {}, 10.0, 0, lambda: True)  # type: ignore[arg-type]
    found: list[tuple[int, int]] = []
    for k in [*range(60), *range(70, 130)]:
        true_ns, trigger = k * SECOND // 10, k + 1 if k < 60 else k - 69
        device_ns = true_ns + 50 * SECOND - (20_000_000 if k >= 60 else 0)
        for packet in source._picture("cam0", RawPicture(device_ns, true_ns + 1_000_000, trigger, DARK)):
            assert isinstance(packet, LostPicture) and packet.cause == "clock"
        found += [(stamp_ns, true_ns) for stamp_ns, *_ in source._held]
        source._held.clear()
    assert max(abs(stamp_ns - true_ns) for stamp_ns, true_ns in found) < 2_000_000
    assert len(found) > 95


@pytest.mark.parametrize(("rate_hz", "back_s"), [(5, 0.6), (10, 0.3), (200, 0.02)])
def test_no_stamp_is_wrong_once_a_clock_was_set_back_by_over_two_intervals(
    rate_hz: int, back_s: float
) -> None:
    clock, newest_ns, off_ns = DeviceClock(), 0, []
    for k in range(6 * rate_hz):
        true_ns = k * SECOND // rate_hz
        device_ns = true_ns + 50 * SECOND - (round(back_s * SECOND) if k > 3 * rate_hz else 0)
        if clock.add(device_ns, true_ns + 1_000_000) and clock.host_ns(device_ns) > newest_ns:
            newest_ns = clock.host_ns(device_ns)
            off_ns.append(newest_ns - true_ns)
    assert clock.jumps == 1 and max(map(abs, off_ns)) < 2_000_000
    assert newest_ns > 5.7 * SECOND and len(off_ns) > 3.4 * rate_hz


def test_a_stamp_that_was_overtaken_or_comes_again_is_no_jump() -> None:
    clock = DeviceClock()
    for k, tick in enumerate([*range(400), 401, 400, 402, 404, 403, 405, 405, 405, 405, 406]):
        clock.add(tick * SECOND // 200, k * SECOND // 200)
    assert clock.jumps == 0 and clock.is_settled


def test_pairs_need_stamp_and_trigger_to_agree() -> None:
    """cam1 counts two ahead; one number is wrong; later cam0 counts anew."""
    former, paired = PairFormer(2), []
    lefts, rights = (5, 6, 7, 8, 1, 2, 3, 4), (7, 8, 10, 10, 11, 12, 13, 14)
    for stamp, left, right in zip(range(0, 80, 10), lefts, rights, strict=True):
        for camera, trigger in enumerate((left, right)):
            picture = LivePicture(camera, stamp + camera, stamp, DARK, trigger)
            paired += [found.stamp_ns for found, _ in former.push(picture)]
    assert paired == [0, 10, 30, 60, 70] and former.contradicted == 6
    assert former.lost == [0, 0] and former.max_skew_ns == former.skew_ns == 1


SET_PPM = 1e9
"""The rate of a clock that is set at once."""


@pytest.mark.parametrize(
    ("ppm", "back_s"),
    [(SET_PPM, 0.017), (SET_PPM, 0.033), (SET_PPM, 0.045), (SET_PPM, 0.066), (1000, 0.1), (5000, 0.035)],
)
def test_neighbours_are_never_paired_over_a_clock_that_is_set_or_slewed(ppm: float, back_s: float) -> None:
    """cam1's, of 30 Hz, after 12 s: they were for 20 to 40 s, with heights 4 % off in mode full."""
    cameras: Any = (SimpleNamespace(ptp=""),) * 2
    source, former = CraneSource(cameras, {}, 30.0, 0, lambda: True), PairFormer(5_000_000)
    rng = np.random.default_rng(0)
    paired: list[tuple[int, int]] = []
    for k in range(30 * 60):
        off_s = min(ppm * max(k / 30 - 12, 0) / 1e6, back_s)
        for camera in (0, 1):
            at_ns, image = k * SECOND // 30, np.full((1, 2), k, np.int16).view(np.uint8)
            device_ns = at_ns + (50 + camera) * SECOND - round(camera * off_s * SECOND)
            arrival_ns = at_ns + 2_000_000 + round(rng.exponential(3e5))
            list(source._picture(f"cam{camera}", RawPicture(device_ns, arrival_ns, k + 1, image)))
        for picture in source._ordered(k * SECOND // 30 - SECOND // 10):
            assert isinstance(picture, LivePicture)
            paired += [
                (int(one.left.view(np.int16)[0, 0]), int(one.right.view(np.int16)[0, 0]))
                for one, _ in former.push(picture)
            ]
    lefts, rights = np.array(paired).T
    assert (lefts == rights).all()
    if ppm == SET_PPM:
        assert source._streams["cam1"].clock.jumps == 1 and len(paired) > 30 * 57


def test_a_camera_that_counted_an_exposure_too_many_is_paired_again() -> None:
    """cam1 of 10 Hz, at 8 s, as by a disturbed trigger line: no pair formed from then on."""
    cameras: Any = (SimpleNamespace(ptp=""),) * 2
    source, former = CraneSource(cameras, {}, 10.0, 0, lambda: True), PairFormer(5_000_000)
    paired: list[int] = []
    for k in range(150):
        at_ns, image = k * SECOND // 10, np.full((1, 2), k, np.uint8)
        for camera in (0, 1):
            count = k + 1 + (camera == 1 and k >= 80)
            picture = RawPicture(at_ns + (50 + camera) * SECOND, at_ns + 2_000_000, count, image)
            list(source._picture(f"cam{camera}", picture))
        for one in source._ordered(at_ns - SECOND // 10):
            assert isinstance(one, LivePicture)
            for pair, _ in former.push(one):
                assert (pair.left == pair.right).all()
                paired.append(int(pair.left[0, 0]))
    assert sum(k >= 80 for k in paired) > 50


@pytest.mark.parametrize("first_hz", [30, 5])
def test_a_camera_that_is_faster_than_stated_is_followed(first_hz: int) -> None:
    """One of 30 Hz, stated as 10 Hz, lost every second picture, and its clock began anew with each other one:
    no pair ever formed.
    """
    cameras: Any = (SimpleNamespace(ptp=""),) * 2
    source, at_ns, image = CraneSource(cameras, {}, 10.0, 0, lambda: True), 0, np.zeros((1, 2), np.uint8)
    for k in range(30 * 8):
        at_ns += SECOND // (first_hz if k < 30 else 30)
        picture = RawPicture(50 * SECOND + at_ns, at_ns + 2_000_000, k + 1, image)
        lost = list(source._picture("cam0", picture))
        assert not lost or k < 30 + 2 + 31
    assert source._streams["cam0"].clock.jumps == (first_hz == 5)


def test_datagrams_are_read_and_what_is_lost_or_torn_counts() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    settings = ReadingsSettings(port=port, rate_hz=20)
    receiver, out = ReadingReceiver("crane", settings), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    place = (1.5, -2.0, 8.0)
    whole = [pack("crane", number, 100 + number, place) for number in (7, 8, 8, 11)]
    sent = [whole[0] + whole[1], whole[2], b"BSC1", pack("imu", 1, 5, (0.0,) * 6), whole[3]]
    sent += [struct.pack("<4sIq3d", b"BSC1", 12, 112, *place[:2], wrong) for wrong in (float("nan"), 1e12)]
    for data in sent:
        out.sendto(data, ("127.0.0.1", port))
    give_up = time.monotonic() + 0.5
    found = list(receiver.readings(lambda: time.monotonic() < give_up, lambda: 42))
    assert [(one.device_ns, one.values, one.lost) for one in found] == [
        (107, place, 0), (108, place, 0), (111, place, 2),
    ]  # fmt: skip
    assert receiver.torn == 4 and found[0].arrival_ns == 42
    assert (receiver.sequence.overtaken, receiver.sequence.restarts) == (1, 0)
    with pytest.raises(bs.BarsightError, match=rf"crane: UDP port {port} can't be opened"):
        ReadingReceiver("crane", settings)
    receiver.close()
    out.close()


STEP_NS = 50_000_000


@pytest.mark.parametrize("keeps_order", [True, False])
@pytest.mark.parametrize(
    "clock_ns",
    [0, -(10**18), 10**18],
    ids=["its clock goes on", "its clock begins anew too", "its clock is set"],
)
@pytest.mark.parametrize("first", [0, 40, 5_000, 9_990, 1 << 30, 3 << 30])
def test_a_sender_that_begins_anew_is_told(first: int, clock_ns: int, keeps_order: bool) -> None:
    """Whatever number the first reading has that comes of it; silent for half a minute before."""
    sequence, restart = Sequence(20, keeps_order=keeps_order), 10_000 + 600
    for k in range(10_001):
        assert sequence.lost_before(k, k * STEP_NS, k * STEP_NS + 7) == 0
    taken = []
    for k in range(40):
        stamp = (restart + k) * STEP_NS
        lost = sequence.lost_before(first + k, clock_ns + stamp, stamp + 7)
        taken += [] if lost is None else [(k, lost)]
    late = 2 if clock_ns < 0 and not keeps_order else 0
    assert taken == [(k, 0) for k in range(late, 40)]
    assert (sequence.restarts, sequence.overtaken) == (1, late)


@pytest.mark.parametrize("rate_hz", [20, 1000])
def test_readings_that_are_overtaken_or_doubled_begin_nothing_anew(rate_hz: int) -> None:
    """Each up to 0.2 s late; one in ten lost, one in ten doubled; the numbers wrap, and all stops for 2 s."""
    rng, step = np.random.default_rng(5), SECOND // rate_hz
    count, first = 3 * rate_hz, (1 << 32) - rate_hz
    due = np.arange(count) * step + np.where(np.arange(count) > 2 * rate_hz, 2 * SECOND, 0)
    lost = rng.uniform(size=count) < 0.1
    sent = np.concatenate([np.flatnonzero(~lost), np.flatnonzero(rng.uniform(size=count) < 0.1)])
    arrival = due[sent] + rng.integers(0, SECOND // 5, len(sent))
    sequence, taken, missing = Sequence(rate_hz, keeps_order=False), [], 0
    for k in np.argsort(arrival).tolist():
        number = int(sent[k])
        found = sequence.lost_before((first + number) % (1 << 32), int(due[number]), int(arrival[k]))
        if found is not None:
            taken.append(number)
            missing += found
    assert (np.diff(taken) > 0).all() and len(taken) + missing == taken[-1] - taken[0] + 1
    assert sequence.restarts == 0 and sequence.overtaken == len(sent) - len(taken) > 0


class Broken:
    """A camera whose driver fails in a way that nobody foresaw."""

    name, trouble, ptp, connects = "cam0", "", "", 1

    def pictures(self, may_go_on: Any) -> Any:
        yield RawPicture(1, 1, 1, DARK)
        raise ValueError("not foreseen")


def test_a_sensor_whose_thread_fails_ends_the_capture_with_its_error() -> None:
    """Else the sensor would be silent for the rest of the run; the process begins anew."""
    give_up = time.monotonic() + 5.0
    source = CraneSource((Broken(), Broken()), {}, 30.0, 0, lambda: time.monotonic() < give_up)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="not foreseen"):
        list(source.packets({"cam0": 0, "cam1": 0}))


def test_readings_wait_while_all_is_held_up_and_pictures_that_find_no_room_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An IMU of 1 kHz for 1.5 s, its clock settled before; with room for four pictures."""
    monkeypatch.setattr(crane_module, "RAW_PICTURES", 4, raising=False)
    source = CraneSource((), {"imu": None}, 30.0, 0, lambda: True)  # type: ignore[arg-type, dict-item]
    given: list[Any] = []
    for k in range(3000):
        source._put("imu", RawReading(k * 1_000_000, k * 1_000_000 + 5, (0.0,) * 6, 0))
        if k < 1500:
            given += source._next()
    for k in range(6):
        source._put("cam0", RawPicture(k, k, k, np.zeros((2, 2), np.uint8)))
    late = list(source._next())
    (readings,) = (one for one in late if isinstance(one, Readings))
    assert len(readings.stamp_ns) == 1500
    lost = [one for one in (*given, *late) if isinstance(one, LostPicture)]
    assert sum(one.count for one in lost if one.cause == "backpressure") == 2
    source._put("cam0", RawPicture(9, 9, 9, np.zeros((2, 2), np.uint8)))
    assert not any(one.cause == "backpressure" for one in source._next() if isinstance(one, LostPicture))


def test_the_oldest_unprotected_segments_go_first(tmp_path: Path) -> None:
    """Each segment is 10 % of a disk that holds ten."""
    for day, count in (("20260101", 3), ("20260102", 3), ("20260103", 2)):
        (tmp_path / day).mkdir()
        for number in range(count):
            (tmp_path / day / f"segment_{number:06d}.mcap").write_bytes(b"")
    (tmp_path / "20260101" / PROTECTED).write_text("")
    (tmp_path / "20260102" / "camchain.yaml").write_text("")
    (tmp_path / "notes").mkdir()
    more = 0

    def used(_: Path) -> float:
        return 0.1 * (len(list(tmp_path.rglob("*.mcap"))) + more)

    keeper = Retention(tmp_path / "20260103", 0.75, 0.95, used)
    assert keeper.tidy() == 1 and not keeper.is_full
    assert not (tmp_path / "20260102" / "segment_000000.mcap").exists()
    more = 4
    assert keeper.tidy() == 2 and not (tmp_path / "20260102").exists() and not keeper.is_full
    more = 5
    assert keeper.tidy() == 0 and keeper.is_full, "nothing is left that may go"
    assert len(list((tmp_path / "20260101").iterdir())) == 4 and (tmp_path / "notes").is_dir()
    more = 0
    assert keeper.tidy() == 0 and not keeper.is_full


def test_what_another_run_is_recording_stays(tmp_path: Path) -> None:
    """Two cranes, one folder of recordings: the run that began later deleted the other's."""
    for day in ("20260101", "20260102", "20260103"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "segment_000000.mcap").touch()
    with held_folder(tmp_path / "20260101"):
        assert Retention(tmp_path / "20260103", 0.85, 0.95, lambda _: 0.9).tidy() == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["20260101", "20260103"]


def test_recordings_dated_ahead_go_first(tmp_path: Path) -> None:
    """The clock was wrong when they were made, and has been set back since: they are the older ones."""
    for name in ("20200101T000000", "20200102T000000", "20990101T000000", "20200103T000000"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "segment_000000.mcap").touch()

    def used(_: Path) -> float:
        return 0.1 * len(list(tmp_path.rglob("*.mcap")))

    assert Retention(tmp_path / "20200103T000000", 0.35, 0.95, used).tidy() == 1
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == ["20200101T000000", "20200102T000000", "20200103T000000"]


GOOD = """
calibration = "rig.yaml"
[cameras]
serials = ["A1", "B2"]
rate_hz = 30
exposure_us = 800
[encoders]
port = 5602
rate_hz = 20
p_crane_body_m = [0.4, 0.0, -1.5]
R_yard_body = [1, 0, 0, 0, -1, 0, 0, 0, -1]
position_std_m = 0.002
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[0.4, 0.0, -1.5]", "[400, 0, -1500]", "encoders.p_crane_body_m must lie in -30...30"),
        ("p_crane_body_m", "p_crane_body_mm", "did you mean p_crane_body_m"),
        ("exposure_us = 800", "exposure_us = 0.0008", "cameras.exposure_us must lie in 5...200000"),
        ("exposure_us = 800", "exposure_us = 40000", "over the interval between pictures, 33333"),
        ('"B2"', '"A1"', "names A1 twice"),
        (
            "[encoders]",
            "[imu]\nport = 5602\nrate_hz = 200\n[encoders]",
            "imu and encoders are both at UDP port",
        ),
        (
            "[encoders]\nport = 5602",
            '[imu]\ndevice = "a"\nbaud = 460800\nrate_hz = 200\n[encoders]\ndevice = "a"\nbaud = 921600',
            "imu and encoders are both at a;",
        ),
        ("0, -1, 0, 0", "0, 1, 0, 0", "encoders.R_yard_body"),
        ("position_std_m = 0.002", "position_std_m = 2", "encoders.position_std_m must lie in"),
        ("port = 5602", "port = 99999", "encoders.port must lie in 1...65535"),
        ("rate_hz = 30", "", "cameras.rate_hz is missing"),
        ("cam0: A1", "cam0: B2", "crane.toml exchanges them"),
        ("cam0: A1", "cam0: C3", "it is of another rig"),
    ],
)
def test_a_wrong_crane_toml_is_refused_by_name(
    old: str, new: str, words: str, whole: Path, tmp_path: Path
) -> None:
    from barsight.calibration.files.rig_file import write_rig_file

    serials = {"cam0: A1": ("A1", "B2"), "cam0: B2": ("B2", "A1"), "cam0: C3": ("C3", "B2")}
    write_rig_file(tmp_path / "rig.yaml", bs.open_recording(whole).rig)
    plain = (tmp_path / "rig.yaml").read_text()
    config = tmp_path / "crane.toml"
    config.write_text(GOOD)
    for pair in (("A1", "B2"), serials.get(new, ("A1", "B2"))):
        text = plain.replace("cam0:\n", f"cam0:\n  serial: {pair[0]}\n", 1)
        (tmp_path / "rig.yaml").write_text(text.replace("cam1:\n", f"cam1:\n  serial: {pair[1]}\n", 1))
        if pair == ("A1", "B2"):
            assert read_crane(config).rig().baseline_m > 0
    config.write_text(GOOD.replace(old, new))
    with pytest.raises(bs.BarsightError) as error:
        read_crane(config).rig()
    assert words in str(error.value) and "\n" not in str(error.value)


@pytest.fixture
def described(whole: Path, tmp_path: Path) -> Path:
    """crane.toml of no cameras that exist, with encoders at a free port."""
    from barsight.calibration.files.rig_file import write_rig_file

    write_rig_file(tmp_path / "rig.yaml", bs.open_recording(whole).rig)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    named = GOOD.replace("rate_hz = 30\n", 'rate_hz = 30\ninterface = "127.0.0.1"\n')
    (tmp_path / "crane.toml").write_text(named.replace("5602", str(port)))
    return tmp_path / "crane.toml"


def send(port: int, until: threading.Event) -> None:
    """Send readings of a crane that stands, 20 a second."""
    number = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        while not until.wait(0.05):
            place = (1.0 + 0.001 * (number % 2), 2.0, 8.0)
            out.sendto(pack("crane", number, time.monotonic_ns(), place), ("127.0.0.1", port))
            number += 1


def test_a_machine_is_checked_line_by_line(described: Path, capsys: pytest.CaptureFixture[str]) -> None:
    crane, ended = read_crane(described), threading.Event()
    assert crane.encoders is not None
    sender = threading.Thread(target=send, args=(crane.encoders.port, ended))
    sender.start()
    try:
        code = cli(["live", "check", "--config", str(described), "-o", str(described.parent / "runs")])
    finally:
        ended.set()
        sender.join()
    told = capsys.readouterr()
    lines = {line[7:].split(":")[0]: line for line in told.out.splitlines()}
    assert code == 5 and "can't run live: " in told.err and "cameras" in told.err
    assert lines["cameras"].startswith("FAILED cameras: ") and "; " in lines["cameras"]
    for what in ("cores", "writing runs", "crane", "readings", "MTU of lo"):
        assert lines[what].startswith("ok ") or what in told.err
    assert lines["crane"].startswith("ok ") and lines["MTU of lo"].startswith("ok ")
    assert all("needed: " in line for line in lines.values()) and "clock" in lines
    assert not (described.parent / "runs").exists() and not list(described.parent.glob(".barsight*"))


def test_what_a_machine_lacks_is_named_with_a_remedy(described: Path, tmp_path: Path) -> None:
    text = described.read_text()
    described.write_text(
        text.replace('interface = "127.0.0.1"', 'interface = "lo"\npacket_size_bytes = 16000').replace(
            "rate_hz = 30\n", "rate_hz = 200\n"
        )
        + "[live]\nring_pairs = 1000\nkeyframe_way_m = 0.0001\n"
    )
    crane = replace(read_crane(described), encoders=None)
    found = {one.what.split(" (")[0]: one for one in check_machine(crane, tmp_path)}
    ring = 2 * crane.rig().cam0.width * crane.rig().cam0.height * 1000
    assert found["shared memory"].passed == (shutil.disk_usage("/dev/shm").free > ring)
    assert found["disk for runs"].needed.startswith("610.4 GiB for 50 m")
    assert found["writing runs"].needed == "250 MiB/s at 1 m/s"
    each = replace(crane, live=replace(crane.live, keyframe_way_m=0.0))
    every = {one.what.split(" (")[0]: one for one in check_machine(each, tmp_path)}
    assert every["writing runs"].needed == "250 MiB/s at 1 m/s", "each pair of 200 a second"
    described.write_text(text.replace("127.0.0.1", "nosuch0"))
    crane = replace(read_crane(described), encoders=None)
    missing = next(one for one in check_machine(crane, tmp_path) if one.what.startswith("interface"))
    assert missing.passed is False and "nosuch0 isn't there" in missing.found and missing.remedy


@pytest.mark.parametrize(
    ("sensor", "value", "words"),
    [
        ("imu", (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "median acceleration is 1 m/s^2"),
        ("imu", (40.0, 0.0, 0.0, 0.0, 0.0, -9.81), "give it in rad/s"),
        ("imu", (0.0, 0.0, 0.0, 0.0, 0.0, 9.81), "R_yard_body"),
        ("crane", (12_500.0, 300.0, 8_000.0), "give metres, not mm"),
        ("crane", (12.5, 0.3, 8.0), ""),
    ],
)
def test_readings_in_other_units_are_refused_at_the_start(
    sensor: str, value: tuple[float, ...], words: str, described: Path
) -> None:
    """A moment of readings tells its units, and the mounting, which looks down."""
    described.write_text(described.read_text() + "[imu]\nport = 5601\nrate_hz = 200\n")
    crane = read_crane(described)
    awaited = crane.described(described.parent / "recording")
    count, rate_hz = 100, crane.sensors()[sensor].rate_hz
    stamps = 10**18 + (np.arange(count) * SECOND / rate_hz).astype(np.int64)
    heard = held(awaited, sensor, [RawReading(int(stamp), 0, value, 0) for stamp in stamps])
    if not words:
        expect_plausible(heard)
        return
    with pytest.raises(bs.BarsightError) as error:
        expect_plausible(heard)
    assert words in str(error.value) and "\n" not in str(error.value)
