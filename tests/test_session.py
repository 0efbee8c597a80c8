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
from barsight.core.records.sensor_samples import CraneSamples
from barsight.mapping.view import Matcher
from barsight.motion.frontend.tracking import Tracker
from barsight.pipeline import lift_choice
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
