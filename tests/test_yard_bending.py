"""A crane that bends: drawn exactly, calibrated by targets, kept in yard.yaml, applied with its sigma."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.files.yaml_document import read_document, write_document
from barsight.calibration.geometry.rectification import Rectifier
from barsight.cli.main import run
from barsight.core.arrays import Float64
from barsight.core.errors import CalibrationError, Failed
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.motion.settings import MotionSettings, make_estimator
from barsight.recording.open import open_recording
from barsight.registration.bending import ORDINARY, CraneBend, calibrate_bent_yard, straight
from barsight.registration.yard_file import YardFrame, read_yard_file, write_yard_file
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.travel import GirderSettings, TravelSettings
from barsight.simulation.trajectory import CRANE_TO_BODY_M, SimulatedTrajectory
from barsight.yard_frame import crane_in_yard, in_yard, shared_height_sigma_m, with_shared

GIRDER, RAILS = (-8.0, 8.0), (-5.0, 25.0)
TURN = Rotation.from_rotvec([0.002, -0.001, 0.4]).as_matrix()
SHIFT = np.array([100.0, 20.0, 0.05])
EYE_M = 6.0
DOWN = np.diag([1.0, -1.0, -1.0])


def truly(values: Float64, crane_m: Float64, point_m: Float64) -> Float64:
    """Move a point (3,) as the crane point (3,) moves and tilts that it is seen from, written out by hand."""
    sag, skew, rail = values
    (y0, y1), (x0, x1) = GIRDER, RAILS
    u, v = (crane_m[1] - y0) / (y1 - y0), (crane_m[0] - x0) / (x1 - x0)
    down = sag * (1 - (2 * u - 1) ** 2) + rail * (1 - (2 * v - 1) ** 2)
    roll = -sag * 4 * (1 - 2 * u) / (y1 - y0)  # a slope that rises with y turns +y up
    pitch = rail * 4 * (1 - 2 * v) / (x1 - x0)
    aside = skew * (crane_m[1] - (y0 + y1) / 2)
    away = point_m - crane_m
    tilted = np.array([pitch * away[2], -roll * away[2], roll * away[1] - pitch * away[0]])
    moved: Float64 = point_m + np.array([aside, 0, -down]) + tilted
    return moved


def drawn(rng: np.random.Generator, count: int) -> tuple[Float64, Float64]:
    """Draw points (N, 3) by readings, and the crane's places (N, 3) that they are seen from."""
    points = rng.uniform((0, -7, 0), (20, 7, 1.5), (count, 3))
    from_m = points[:, :2] + rng.uniform(-1, 1, (count, 2))
    return points, np.column_stack([from_m, np.full(count, EYE_M)])


def calibrated(folder: Path, seed: int) -> tuple[Float64, CraneBend, YardFrame]:
    """Six targets with 2 mm of noise, spread over girder and rails, on a crane that bends as an ordinary one;
    its true values.
    """
    rng = np.random.default_rng((24, seed))
    values = rng.normal(0, ORDINARY)
    points, cranes = drawn(rng, 6)
    spread = np.array([[2, -6], [10, -6], [18, 0], [2, 0], [10, 6], [18, 6]]) + rng.uniform(-1, 1, (6, 2))
    cranes[:, :2] += spread - points[:, :2]
    points[:, :2] = spread
    true = np.array([truly(values, c, p) for c, p in zip(cranes, points, strict=True)])
    yard = true @ TURN.T + SHIFT + rng.normal(0, 0.002, (6, 3))
    bend = straight(GIRDER, RAILS)
    shift, tilt = bend.slopes(cranes)
    slopes = shift + np.stack(
        [np.cross(tilt[:, :, k], points - cranes) for k in range(3)], axis=2
    )  # as an estimate of the travel would show them
    found = calibrate_bent_yard(
        tuple("abcdef"), points, slopes, yard, np.tile(4e-6 * np.eye(3), (6, 1, 1)), np.zeros(6, bool),
        "encoders", bend,
    )  # fmt: skip
    assert not isinstance(found, Failed)
    path = folder / f"yard_{seed}.yaml"
    write_yard_file(path, found[0], None, {"calibration_id": "own"}, found[1])
    frame = read_yard_file(path)
    assert frame.bend is not None and frame.bend.covariance == pytest.approx(found[1].covariance)
    assert frame.covariance == pytest.approx(frame.bend.covariance[:6, :6])
    return values, frame.bend, frame


def test_check_points_lie_within_5_mm_and_inside_sigma_under_a_girder_that_bends(tmp_path: Path) -> None:
    away, stiff, inside, off_sigma = [], [], [], []
    for seed in range(40):
        values, bend, frame = calibrated(tmp_path, seed)
        points, cranes = drawn(np.random.default_rng((25, seed)), 100)
        pose = frame.yard_from
        for point, crane in zip(points, cranes, strict=True):
            true = TURN @ truly(values, crane, point) + SHIFT
            said = pose.apply(truly(bend.values, crane, point)[None])[0]
            away.append(np.linalg.norm(said - true))
            stiff.append(np.linalg.norm(pose.apply(point[None])[0] - true))
            at = pose.apply(np.stack([point, crane]))
            sigma = shared_height_sigma_m(frame, at[:1, 0], at[:1, 1], at[1])
            inside.append(abs(said[2] - true[2]) < 2 * sigma[0])
        off_sigma.append((bend.values - values) / bend.sigma)
    assert np.percentile(away, 95) < 0.005 < 0.01 < np.percentile(stiff, 95)
    assert 0.9 < np.mean(inside) < 0.995
    assert 0.8 < np.std(off_sigma) < 1.2


def test_frame_and_bend_err_as_they_say_where_depths_are_less_sure() -> None:
    squares = []
    for seed in range(60):
        rng = np.random.default_rng((26, seed))
        points, cranes = drawn(rng, 14)
        bend, values = straight(GIRDER, RAILS), rng.normal(0, ORDINARY)
        shift, tilt = bend.slopes(cranes)
        slopes = shift + np.cross(tilt, (points - cranes)[:, :, None], axis=1)
        ray = np.column_stack([rng.normal(0, 0.3, (14, 2)), np.ones(14)])
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        covariance = 1e-6 * np.eye(3) + 24e-6 * ray[:, :, None] * ray[:, None, :]
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(0, 1, (14, 3)))
        yard = (points + slopes @ values) @ TURN.T + SHIFT + noise
        found = calibrate_bent_yard(
            tuple("abcdefghijklmn"), points, slopes, yard, covariance, np.zeros(14, bool), "encoders", bend
        )
        assert not isinstance(found, Failed)
        pose = found[0].alignment.target_from_source
        turned = Rotation.from_matrix(TURN @ pose.rotation.T).as_rotvec()
        off = np.concatenate([turned, SHIFT - pose.translation, values - found[1].values])
        squares.append(off @ np.linalg.solve(found[1].covariance, off) / 9)
    assert 0.8 < np.mean(squares) < 1.25


def test_checks_where_the_bend_is_unsure_are_judged_by_its_sigma() -> None:
    """Targets under one third of the girder hardly tell its sag: of honest checks elsewhere, every third
    list was refused.
    """
    refused = 0
    for seed in range(40):
        rng = np.random.default_rng((27, seed))
        points, cranes = drawn(rng, 12)
        points[:, 1] = cranes[:, 1] = np.where(
            np.arange(12) < 8, rng.uniform(-7, -3, 12), rng.uniform(1, 7, 12)
        )
        bend, checks = straight(GIRDER, RAILS), np.arange(12) >= 8
        shift, tilt = bend.slopes(cranes)
        slopes = shift + np.cross(tilt, (points - cranes)[:, :, None], axis=1)
        yard = (points + slopes @ rng.normal(0, ORDINARY)) @ TURN.T + SHIFT + rng.normal(0, 0.003, (12, 3))
        covariance = np.tile(9e-6 * np.eye(3), (12, 1, 1))
        found = calibrate_bent_yard(
            tuple("abcdefghijkl"), points, slopes, yard, covariance, checks, "encoders", bend
        )
        assert not isinstance(found, Failed)
        refused += bool(found[0].contradictions)
    assert refused <= 1


def test_the_bend_is_taken_off_the_readings_and_its_sigma_is_shared(tmp_path: Path) -> None:
    _, bend, frame = calibrated(tmp_path, 3)
    lever, hangs = np.array([0.3, 0.1, -0.5]), DOWN
    places = np.array([[1.0, -6.5, 6.0], [9.0, 0.0, 6.0], [18.0, 7.0, 6.0]])
    moved = crane_in_yard(CraneSamples(np.arange(3), places, lever, hangs, 0.001), frame)
    really = [truly(bend.values, place, place + lever) for place in places]
    assert moved.position_m + moved.crane_to_body_m == pytest.approx(frame.yard_from.apply(np.array(really)))
    tilts = [
        truly(bend.values, place, place + axis) - truly(bend.values, place, place) - axis
        for place in places
        for axis in np.eye(3)
    ]
    mean = np.mean(np.reshape(tilts, (3, 3, 3)), axis=0).T
    turned = frame.yard_from.rotation @ (np.eye(3) + mean) @ hangs
    assert moved.yard_from_body_nominal == pytest.approx(turned, abs=1e-5)

    none = crane_in_yard(CraneSamples(np.arange(0), np.empty((0, 3)), lever, hangs, 0.001), frame)
    assert none.yard_from_body_nominal == pytest.approx(frame.yard_from.rotation @ hangs)

    body = frame.yard_from.apply(places[:1])[0]
    at = PosedFrame(1, Pose("yard", "body", hangs, body), 1e-9 * np.eye(6))
    shared = with_shared(Trajectory("yard", (at,), (), ()), frame).frames[0].covariance - at.covariance
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(9), bend.covariance, 4000)
    arm, straight_m = body - frame.yard_from.translation, truly(bend.values, places[0], places[0])
    scattered = [
        np.cross(e[:3], arm) + e[3:6] + TURN @ (truly(bend.values + e[6:], places[0], places[0]) - straight_m)
        for e in errors
    ]
    assert np.sqrt(np.diag(shared)[3:]) == pytest.approx(np.std(scattered, axis=0), rel=0.06)


def test_what_targets_do_not_tell_is_held_to_an_ordinary_crane_and_said(tmp_path: Path) -> None:
    """The trolley stands still: the girder's deflection can't be told from the frame's height."""
    rng = np.random.default_rng(5)
    points, cranes = drawn(rng, 8)
    cranes[:, 1] = 1.0
    bend = straight(GIRDER, None)
    shift, tilt = bend.slopes(cranes)
    slopes = shift + np.stack([np.cross(tilt[:, :, k], points - cranes) for k in range(3)], axis=2)
    yard = points @ TURN.T + SHIFT + rng.normal(0, 0.002, (8, 3))
    covariance = np.tile(4e-6 * np.eye(3), (8, 1, 1))
    found = calibrate_bent_yard(
        tuple("abcdefgh"), points, slopes, yard, covariance, np.zeros(8, bool), "encoders", bend
    )
    assert not isinstance(found, Failed)
    calibration, bent = found
    assert bent.sigma[0] == pytest.approx(ORDINARY[0], rel=0.05) and bent.sigma[2] == bent.values[2] == 0
    assert any("hardly tell deflection_m" in doubt for doubt in calibration.doubts)
    assert calibration.alignment.covariance[5, 5] ** 0.5 > 0.9 * ORDINARY[0], "the height is as unsure"


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("deflection_m", 3.0, "deflection_m: can't be 3"),
        ("girder_y_m", [8.0, -8.0], "girder_y_m: can't be 8 to -8 m"),
        ("covariance", [[1.0]], "covariance: is not a 9x9 matrix"),
        ("skew_rad", None, "skew_rad: is missing"),
    ],
)
def test_a_spoilt_bend_is_refused(tmp_path: Path, key: str, value: object, said: str) -> None:
    calibrated(tmp_path, 0)
    path = tmp_path / "yard_0.yaml"
    values = read_document(path).values
    write_document(path, {**values, "bend": {**values["bend"], key: value}})
    with pytest.raises(CalibrationError, match=re.escape(said)):
        read_yard_file(path)


def test_a_simulated_girder_moves_the_body_as_geometry_has_it() -> None:
    girder = GirderSettings(
        deflection_m=0.012, ends_y_m=GIRDER, skew_mm_per_m=0.5, rail_m=0.006, rail_ends_x_m=RAILS
    )
    camera, motion = CameraSettings(trolley_y_m=-3), TravelSettings(trolley_m=6)
    ways = [
        SimulatedTrajectory.plan(8.0, camera, motion, DOWN, np.random.default_rng(3), girder=one)
        for one in (GirderSettings(), girder)
    ]
    times = np.linspace(0, ways[0].duration_s, 20)
    plain, bent = (way.at(times) for way in ways)
    lever, values = np.array(CRANE_TO_BODY_M), np.array([0.012, 0.0005, 0.006])
    cranes = ways[1].wheels_m(times) - lever
    assert cranes == pytest.approx(ways[0].wheels_m(times) - lever), "no encoder sees it"
    moved = [truly(values, c, c + lever) - c - lever for c in cranes]
    assert bent.position_m - plain.position_m == pytest.approx(np.array(moved), abs=5e-6)
    turns = np.einsum("nij,nkj->nik", bent.yard_from_body, plain.yard_from_body)
    for turn, crane in zip(turns, cranes, strict=True):
        tilted = [truly(values, crane, crane + axis) - truly(values, crane, crane) for axis in np.eye(3)]
        assert turn == pytest.approx(np.array(tilted).T, abs=2e-5)
    step_s = 1e-4
    around = [ways[1].at(times + by) for by in (-step_s, step_s)]
    rate = (around[1].position_m - around[0].position_m) / (2 * step_s)
    assert bent.velocity_mps == pytest.approx(rate, abs=1e-6)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--girder-y-m", "-8", "8"], "needs --tags"),
        (["--rails-x-m", "0", "8"], "needs --girder-y-m"),
        (["--tags", "t.csv", "--girder-y-m", "8", "-8"], "lower reading first"),
    ],
)
def test_ends_that_cannot_be_are_refused(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["calibrate", "yard", str(tmp_path / "rec"), "-o", str(tmp_path / "yard.yaml")]
    assert run([*line, *words]) == 2
    assert said in capsys.readouterr().err.replace("\n", " ")


def rendered(folder: Path, seed: int) -> tuple[Path, Path]:
    """A recording of a girder that bends by 12 mm, bridge and trolley under way, with nine tags."""
    rng = np.random.default_rng((24, seed))
    x, y = np.linspace(0.3, 6.7, 9), np.linspace(-4.6, 4.6, 9)
    aside = np.array([1.3, -0.3, -1.3, 1.2, 0.4, -1.3, 1.3, -0.5, -1.2])
    y = y + aside * rng.uniform(0.8, 1.1, 9)
    places = np.column_stack([x, y, rng.uniform(0.9, 1.3, 9)])
    noisy = places + rng.normal(0, 0.001, (9, 3))
    files = []
    for name, at in (("laid.csv", places), ("tags.csv", noisy)):
        rows = [
            f"{k + 3},{p[0]:.5f},{p[1]:.5f},{p[2]:.5f},0.001,{int(k in (1, 4, 7))}" for k, p in enumerate(at)
        ]
        files.append(folder / name)
        files[-1].write_text("\n".join(["tag,yard_x,yard_y,yard_z,sigma_m,check", *rows, ""]))
    line = ["simulate", str(folder / "rec"), "--tags", str(files[0]), "--length", "7", "--frames", "24"]
    line += ["--seed", str(seed), "--depth-views", "0", "--motion.trolley-m", "10", "--yard.max-layers", "1"]
    line += ["--camera.width-px", "640", "--camera.height-px", "512", "--camera.focal-px", "625"]
    line += ["--camera.above-floor-m", "6", "--camera.trolley-y-m", "0", "--girder.deflection-m", "0.012"]
    line += ["--girder.ends-y-m", "-6", "6", "--girder.skew-mm-per-m", "0.5"]
    assert run(line) == 0
    return folder / "rec", files[1]


@pytest.mark.slow
def test_tags_calibrate_a_girder_that_bends_and_measure_straightens_it(tmp_path: Path) -> None:
    recording, tags = rendered(tmp_path, 6701)
    line = ["calibrate", "yard", str(recording), "--tags", str(tags), "-o", str(tmp_path / "yard.yaml")]
    assert run([*line, "--girder-y-m", "-6", "6"]) == 0
    frame = read_yard_file(tmp_path / "yard.yaml")
    assert frame.bend is not None
    off = (frame.bend.values - (0.012, 0.0005, 0)) / np.maximum(frame.bend.sigma, 1e-9)
    assert np.abs(off[:2]).max() < 3 and frame.bend.sigma[0] < 0.016, "an ordinary crane: 0.02"
    rows = json.loads((tmp_path / "yard.json").read_text())["table"]
    for row in (row for row in rows if row["kind"] == "check"):
        length = np.linalg.norm(row["off_mm"])
        assert length < 5 and length < 2.8 * row["sigma_mm"], "99.9 % of three coordinates by chance"
    source = in_yard(open_recording(recording), tmp_path / "yard.yaml")
    way = make_estimator(MotionSettings())(source, Rectifier(source.rig), lambda *_: None)
    truth = np.loadtxt(recording / "mav0/state_groundtruth_estimate0/data.csv", delimiter=",", skiprows=1)
    late_ns, below, off = source.rig.timeshift_cam_imu_ns, np.array([0, 0, -5.0]), []
    for one in way.frames:  # what lies under the cameras, among the tags
        row = truth[np.abs(truth[:, 0].astype(np.int64) - one.stamp_ns - late_ns).argmin()]
        seen = Rotation.from_quat(row[[5, 6, 7, 4]]).inv().apply(below)
        off.append(one.reference_from_body.apply(seen[None])[0] - row[1:4] - below)
    assert np.linalg.norm(off, axis=1).max() < 0.006, "10 mm without the bend"
