"""`trajectory-degraded`: only where the trajectory, near the lift, isn't as sure as the magnet needs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera, RefusedFrame
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.yard.lifting.travel_accuracy import Travel, travel_checks
from barsight.yard.magnet.footprint import Placement
from barsight.yard.vetoes import vetoes_of
from lift_yards import MAGNET, SETTINGS

CAMERA = RectifiedCamera(1250.0, 320.0, 256.0, 0.5, 0.0, 640, 512)
RANGE_M, SPEED, FRAMES = 7.5, 0.5, 21
STAMPS = (np.arange(FRAMES) * 1e9).astype(np.int64)
X_M = SPEED * np.arange(FRAMES)
HERE, THERE = Placement(2.0, 0.0, 0.0), Placement(8.0, 0.0, 0.0)


def travel(
    sigma_m: float = 0.001, sigma_rad: float = 1e-4, unsure_beyond_m: float = np.inf, encoders: object = None,
    refused: tuple[int, ...] = (),
) -> Travel:  # fmt: skip
    """21 frames over 10 m, one a second; their sigmas are 30 times as large beyond `unsure_beyond_m`."""
    frames = []
    for k in set(range(FRAMES)) - set(refused):
        scale = 30.0 if X_M[k] > unsure_beyond_m else 1.0
        covariance = np.diag([(scale * sigma_rad) ** 2] * 3 + [(scale * sigma_m) ** 2] * 3)
        pose = Pose("yard", "body", np.eye(3), np.array([X_M[k], 0.0, 8.0]))
        frames.append(PosedFrame(int(STAMPS[k]), pose, covariance))
    gone = tuple(RefusedFrame(int(STAMPS[k]), "blurred") for k in refused)
    trajectory = Trajectory("yard", tuple(frames), gone, ("crane", "stereo"))
    return Travel.of(trajectory, encoders, 0, int(0.35e9), RANGE_M, CAMERA, STAMPS.tolist())  # type: ignore[arg-type]


def encoders(
    slip_m: float = 0.0, first_m: float = 0.0, last_m: float = np.inf, late_s: float = 0.0
) -> CraneSamples:
    """Readings at 20 Hz that are off by slip_m in x between two places."""
    stamps = np.arange(int(-1e9), int(STAMPS[-1] + 1e9), int(5e7))
    x = SPEED * (stamps / 1e9 - late_s)
    x = x + np.where((x >= first_m) & (x <= last_m), slip_m, 0.0)
    places = np.stack([x, np.zeros_like(x), np.full_like(x, 8.0)], axis=1)
    return CraneSamples(stamps, places, np.zeros(3), np.eye(3), 0.001)


def reasons(one: Travel, place: Placement) -> list[str]:
    vetoes = vetoes_of(travel_checks(one, place, MAGNET, SETTINGS))
    assert {veto.code for veto in vetoes} <= {"trajectory-degraded"}
    return [veto.reason for veto in vetoes]


def test_a_sure_trajectory_and_agreeing_encoders_forbid_nothing() -> None:
    one = travel(encoders=encoders())
    assert one.off_m.max() < 0.001
    assert reasons(one, HERE) == reasons(one, THERE) == []


def test_place_and_height_must_be_as_sure_as_the_magnet_needs_there() -> None:
    one = travel(unsure_beyond_m=5.0)
    assert reasons(one, HERE) == []
    said = reasons(one, THERE)
    assert [s.startswith("x ") for s in said] == [True, False, False]
    assert [s.startswith("y ") for s in said] == [False, True, False]
    # Straight below, what turns the body moves the ground sideways only.
    lateral = np.hypot(0.03, 0.003 * RANGE_M)
    assert (
        f"x near the lift is uncertain by {1e3 * 1.645 * lateral:.0f} mm (95 %" in said[0]
        and "15 mm" in said[0]
    )
    assert (
        f"height near the lift is uncertain by {1e3 * 1.645 * 0.03:.0f} mm (95 %" in said[2]
        and "8 mm" in said[2]
    )


def test_a_pass_that_is_unsure_is_not_outvoted_by_surer_ones() -> None:
    sure, unsure = travel(), travel(sigma_m=0.03)
    later = [replace(one, stamp_ns=one.stamp_ns + k * 10**12) for k, one in enumerate((sure, sure, unsure))]
    assert reasons(Travel.joined(later[:2]), HERE) == []
    assert any("x near the lift is uncertain" in s for s in reasons(Travel.joined(later), HERE))


def test_pairs_that_record_at_once_are_read_back_and_a_disorder_is_not() -> None:
    one = travel()
    later = replace(one, stamp_ns=one.stamp_ns + 10**9, measured=one.stamp_ns < 0)
    joined = Travel.joined([one, later])
    content = joined.content()
    again = Travel.read({"travel": content, "passes": [{}, {}]})
    assert again is not None and np.array_equal(again.place_m, joined.place_m)
    assert again.pass_number[:4].tolist() == [1, 1, 2, 1] and again.captured_ns == one.captured_ns
    assert np.array_equal(again.place_m[again.pass_number == 2], later.place_m)
    twice = {**content, "pass_number": [1] * len(joined.stamp_ns)}
    assert Travel.read({"travel": twice, "passes": [{}, {}]}) is None
    back = {**content, "stamp_ns": content["stamp_ns"][::-1]}
    assert Travel.read({"travel": back, "passes": [{}, {}]}) is None


def test_a_lift_under_refused_frames_is_forbidden_and_one_beside_them_is_not() -> None:
    one = travel(refused=tuple(range(13, 21)))
    assert reasons(one, HERE) == []
    assert any("frames near the lift were refused" in s for s in reasons(one, THERE))
    assert any("no frame was located" in s for s in reasons(one, Placement(30.0, 0.0, 0.0)))


def test_a_slip_of_the_encoders_forbids_lifts_beside_it() -> None:
    one = travel(encoders=encoders(0.08, 7.4, 8.6))
    assert reasons(one, HERE) == []
    assert any("disagree by 80 mm within 1 m" in s for s in reasons(one, THERE))
    assert reasons(travel(encoders=encoders(0.008, 7.4, 8.6)), THERE) == []


def test_a_slip_forbids_lifts_beside_it_whichever_way_the_crane_goes() -> None:
    """The lift lies 2 m beside the way, along X and along Y."""
    one = travel(encoders=encoders(0.08, 7.4, 8.6))
    turned = replace(one, place_m=one.place_m[:, ::-1])
    for way, near, far in (
        (one, Placement(8.0, 2.0, 0.0), Placement(2.0, 2.0, 0.0)),
        (turned, Placement(2.0, 8.0, np.pi / 2), Placement(2.0, 2.0, np.pi / 2)),
    ):
        assert any("disagree by 80 mm within 1 m" in s for s in reasons(way, near))
        assert reasons(way, far) == []


def test_a_slip_that_stays_forbids_all_lifts_since_the_crane_would_go_beside() -> None:
    one = travel(encoders=encoders(0.08, 7.0))
    assert any("at the end of the travel" in s for s in reasons(one, HERE))


def test_late_encoders_stand_right_when_the_crane_stands() -> None:
    assert reasons(travel(encoders=encoders(late_s=0.2)), HERE) == []
