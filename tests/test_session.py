"""Packets pushed one by one: snapshots on the way, and at the end the bytes of the batch."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import barsight as bs
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import InputError
from barsight.core.records.pairs import StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.mapping.view import Matcher
from barsight.motion.frontend.tracking import Tracker
from barsight.pipeline import lift_choice
from barsight.recording.packets import PacketRecording
from test_yard_frame import calibrated

SETTINGS: dict[str, Any] = {"stereo": {"method": "sgbm"}, "map": {"cell_m": 0.05}}

FILES = ("height.tif", "contour.csv", "trajectory.tum", "cloud.ply")


def counted(patch: pytest.MonkeyPatch, owner: Any, name: str) -> list[str]:
    """Count the calls of a class's method or a module's function."""
    calls: list[str] = []
    method = getattr(owner, name)

    def told(*values: Any, **named: Any) -> Any:
        calls.append(name)
        return method(*values, **named)

    patch.setattr(owner, name, told)
    return calls


def test_packets_are_measured_in_the_surveyed_yard(whole: Path, tmp_path: Path) -> None:
    """No encoder reading has come when the session begins; a yard file of encoders is refused without any."""
    recording = bs.open_recording(whole)
    settings = {**SETTINGS, "yard": calibrated(tmp_path, 3, "encoders")[0].path}
    session = bs.Session(recording.rig, imu_noise=recording.imu_noise(), **settings)
    for packet in bs.packets(recording):
        session.push(packet)
    yard, batch = session.finish(), bs.measure(whole, **settings)
    for name in FILES:
        assert (yard.folder / name).read_bytes() == (batch.folder / name).read_bytes(), name
    other = bs.Session(recording.rig, imu_noise=recording.imu_noise(), **settings)
    with pytest.raises(InputError, match="has no encoders that are used"):
        for packet in bs.packets(recording):
            if not isinstance(packet, CraneSamples):
                other.push(packet)


@pytest.mark.parametrize(
    ("estimator", "method"), [("fused", "sgbm"), ("live", "sgbm"), ("fused", "barsight")]
)
def test_packets_with_snapshots_end_as_the_batch(
    whole: Path, estimator: str, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {**SETTINGS, "motion": {"estimator": estimator}, "stereo": {"method": method}}
    recording = bs.open_recording(whole)
    session = bs.Session(recording.rig, imu_noise=recording.imu_noise(), **settings)
    rectified = counted(monkeypatch, Rectifier, "__call__")
    matched = counted(monkeypatch, Matcher, "__call__")
    tracked = counted(monkeypatch, Tracker, "push")
    shown = []
    for packet in bs.packets(recording):
        session.push(packet)
        if isinstance(packet, StereoFrame):
            shown.append(session.snapshot())
    assert shown[0].surface is None
    assert [one.frames for one in shown] == sorted(one.frames for one in shown)
    last = session.snapshot()
    assert last.frames >= 2
    lifted = counted(monkeypatch, lift_choice, "plan_lifts")
    before = len(matched)
    yard = session.finish()
    pictures = len(recording.index.stamps_ns)
    assert (len(rectified), len(tracked), len(lifted)) == (pictures, pictures, 1)
    # The last pair is matched at the end: none comes after it.
    assert len(matched) <= pictures and (estimator != "live" or len(matched) == before + 1)
    batch = bs.measure(whole, **settings)
    assert len(rectified) == 2 * pictures
    for name in FILES:
        assert (yard.folder / name).read_bytes() == (batch.folder / name).read_bytes(), name
    found, expected = (json.loads((one.folder / "bundles.json").read_text()) for one in (yard, batch))
    assert found["bundles"] == expected["bundles"]
    assert [lift.record for lift in yard.lifts.refused] == [lift.record for lift in batch.lifts.refused]
    heights, final = last.height_map, yard.height_map
    assert heights is not None
    x, y = (
        np.intersect1d(np.rint(a / 0.05), np.rint(b / 0.05))
        for a, b in ((heights.x_m, final.x_m), (heights.y_m, final.y_m))
    )
    parts = [
        one.z_m[np.ix_(np.isin(np.rint(one.y_m / 0.05), y), np.isin(np.rint(one.x_m / 0.05), x))]
        for one in (heights, final)
    ]
    assert np.isfinite(parts[0]).mean() > 0.3
    assert np.nanmedian(np.abs(parts[0] - parts[1])) < 0.01


def test_a_late_packet_is_refused(whole: Path) -> None:
    recording = bs.open_recording(whole)
    session = bs.Session(recording.rig)
    first, second = (frame for frame, _ in zip(recording.frames(), range(2), strict=False))
    session.push(second)
    with pytest.raises(bs.BarsightError, match="comes late; push packets in time's order"):
        session.push(first)
    assert session.snapshot().surface is None


def test_samples_that_say_nothing_are_refused_and_empty_packets_wait(whole: Path) -> None:
    recording = bs.open_recording(whole)
    session, imu = bs.Session(recording.rig), recording.imu()
    assert imu is not None
    part = replace(imu, **{name: getattr(imu, name)[:4] for name in ("stamp_ns", "gyro_radps", "accel_mps2")})
    session.push(replace(part, stamp_ns=part.stamp_ns[:0]))
    with pytest.raises(bs.BarsightError, match="NaN"):
        session.push(replace(part, gyro_radps=np.full((4, 3), np.nan)))
    with pytest.raises(bs.BarsightError, match="comes late"):
        session.push(replace(part, stamp_ns=part.stamp_ns[::-1]))
    session.push(part)
    for frame, _ in zip(recording.frames(), range(2), strict=False):
        session.push(frame)
    assert session.snapshot().frames <= 2


def test_a_finished_session_takes_no_more(whole: Path) -> None:
    recording = bs.open_recording(whole)
    session = bs.Session(recording.rig, SETTINGS)
    frames = list(recording.frames())
    session.push(frames[0])
    session.finish()
    for call in (session.finish, session.snapshot, session.next_pass, lambda: session.push(frames[1])):
        with pytest.raises(bs.BarsightError, match="is finished"):
            call()


def test_a_session_refuses_what_it_could_only_miss_at_the_end(whole: Path, tmp_path: Path) -> None:
    rig: Any = bs.open_recording(whole).rig
    refused: list[tuple[Any, tuple[Any, ...], dict[str, Any], str]] = [
        (rig, (), {"magnet": str(tmp_path / "no.toml")}, "no.toml: no such file"),
        (rig, (), {"map": {"cell_m": "x"}}, "map.cell_m is 'x'; give a number"),
        (rig, ({"preset": "quick"},), {}, "preset is 'quick'; choose best or fast"),
        (rig, (3,), {}, "settings is 3; give its fields by name"),
        (rig, (bs.MeasureSettings(),), {"preset": "fast"}, "settings are given twice; add preset to them"),
        (3, (), {}, "rig is 3; give a StereoRig"),
    ]
    for given, settings, named, line in refused:
        with pytest.raises(bs.BarsightError, match=re.escape(line)):
            bs.Session(given, *settings, **named)


def packed(recording: Any, tmp_path: Path) -> tuple[PacketRecording, StereoFrame, ImuSamples, CraneSamples]:
    frame = next(one for one in recording.frames() if isinstance(one, StereoFrame))
    imu, crane = recording.imu(), recording.crane()
    assert imu is not None and crane is not None
    return PacketRecording(recording.rig, tmp_path), frame, imu, crane


def test_pictures_of_other_kinds_become_the_readers_gray(whole: Path, tmp_path: Path) -> None:
    recording, frame, _, _ = packed(bs.open_recording(whole), tmp_path)
    wide, colour = (frame.left.astype(np.uint16) * 257).astype(">u2"), np.dstack([frame.right] * 3)
    same = bs.StereoFrame(np.int64(frame.stamp_ns), wide, colour)  # type: ignore[arg-type]
    recording.add(same)
    (stored,) = recording.frames()
    assert isinstance(stored, StereoFrame)
    np.testing.assert_array_equal(stored.left, frame.left)
    np.testing.assert_array_equal(stored.right, frame.right)
    refused: list[tuple[Any, Any, str]] = [
        (5, frame.left.astype(np.uint16) * 16, "a 16-bit picture whose brightest value"),
        (5, frame.left / 255, "float64 pixels; 8 or 16 bits are needed; give uint8"),
        (5, np.dstack([frame.left] * 2), "2 channels"),
        (5, np.ma.masked_greater(frame.left, 200), "masked pixels"),
        (5, None, r"shape \(\)"),
        (5.0, frame.left, "stamp 5.0 is no integer of 64 bits; give nanoseconds"),
        (2**70, frame.left, "no integer of 64 bits"),
    ]
    for stamp, picture, said in refused:
        with pytest.raises(InputError, match=said):
            bs.StereoFrame(stamp, picture, frame.right)


def test_whole_numbers_in_a_first_packet_dont_cut_the_later_ones(whole: Path, tmp_path: Path) -> None:
    """Stamps of 32 bits wrapped, and 9.81 became 9."""
    recording, _, imu, _ = packed(bs.open_recording(whole), tmp_path)
    level = np.array([[0, 0, 10]])
    recording.add(replace(imu, stamp_ns=np.array([0], np.int32), gyro_radps=0 * level, accel_mps2=level))
    recording.add(imu)
    kept = recording.imu()
    assert kept is not None
    np.testing.assert_array_equal(kept.stamp_ns[1:], imu.stamp_ns)
    np.testing.assert_array_equal(kept.accel_mps2[1:], imu.accel_mps2)


def test_packets_that_are_no_measurements_are_refused(whole: Path, tmp_path: Path) -> None:
    recording, frame, imu, crane = packed(bs.open_recording(whole), tmp_path)
    late = replace(crane, stamp_ns=crane.stamp_ns + 10**12)
    refused: list[tuple[Any, str]] = [
        (frame.left, "a ndarray is no packet; give one of StereoFrame"),
        ((frame.left, frame.right), "a tuple is no packet"),
        (replace(imu, stamp_ns=imu.stamp_ns / 1e9), "stamps of ImuSamples are float64; give ns"),
        (replace(imu, stamp_ns=5), "stamp_ns of ImuSamples has the shape"),  # type: ignore[arg-type]
        (replace(imu, gyro_radps=imu.gyro_radps[1:]), "gyro_radps of ImuSamples has the shape"),
        (replace(imu, accel_mps2=imu.accel_mps2 / 9.81), "probably in g"),
        (replace(crane, position_m=crane.position_m[:, :2]), "position_m of CraneSamples has the shape"),
        (replace(crane, position_std_m=0.0), "the latter positive"),
        (replace(crane, yard_from_body_nominal=np.ones((3, 3))), "the crane's mounting can't be"),
        (replace(late, crane_to_body_m=crane.crane_to_body_m + 1), "another mounting or sigma"),
        (bs.LaserProfile(0, np.arange(3.0), np.zeros(2), np.zeros(3), 0.01), "y_m of LaserProfile"),
    ]
    for packet, said in refused:
        with pytest.raises(bs.BarsightError, match=said):
            recording.add(packet)
        if said.startswith("the crane's"):
            recording.add(crane)
    assert recording.imu() is None
