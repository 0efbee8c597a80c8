"""A whole simulated recording, read back from its files as a stranger would and held against its truth."""

from __future__ import annotations

import hashlib
import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation, Slerp

from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.core.arrays import Float64
from barsight.core.errors import ConfigError, OutputError
from barsight.core.pose import Pose
from barsight.simulation.optics import mount_rig
from barsight.simulation.scene import build_scene
from barsight.simulation.sensors import heights
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings, SensorSettings
from barsight.simulation.settings.travel import TravelSettings
from barsight.simulation.settings.yard import BarKind, YardSettings, parse_bars
from barsight.simulation.simulate import World, simulate
from barsight.simulation.stock import StackedBundle, stack_yard

SMALL = SimulationSettings(
    length_m=1.5,
    frames=4,
    seed=11,
    camera=CameraSettings(width_px=320, height_px=256, focal_px=312.0),
    yard=YardSettings(max_layers=2),
    motion=TravelSettings(speed_mps=1.0, acceleration_mps2=1.5, standstill_s=1.0),
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated") / "yard"
    simulate(out, SMALL)
    return out


def read_camera(recording: Path, name: str) -> tuple[Camera, Pose]:
    content = yaml.safe_load((recording / f"mav0/{name}/sensor.yaml").read_text())
    width, height = content["resolution"]
    coefficients = tuple(content["distortion_coefficients"])
    camera = Camera(width, height, *content["intrinsics"], Distortion.RADTAN, coefficients)
    return camera, Pose.from_matrix("body", name, np.reshape(content["T_BS"]["data"], (4, 4)))


def true_pose(recording: Path, camera_stamp_ns: int) -> Pose:
    """As score_yard.py reads it: stamps of the truth are on the IMU's clock."""
    file = recording / "mav0/state_groundtruth_estimate0/data.csv"
    rows = np.loadtxt(file, delimiter=",", comments="#")
    stamps = [int(line.split(",")[0]) for line in file.read_text().splitlines()[1:]]
    offset = json.loads((recording / "truth/rig.json").read_text())["time_offset_s"]
    t = (np.array(stamps) - camera_stamp_ns) / 1e9 - offset
    place = np.array([np.interp(0.0, t, rows[:, k]) for k in (1, 2, 3)])
    turn = Slerp(t, Rotation.from_quat(rows[:, [5, 6, 7, 4]]))(0.0)
    return Pose("yard", "body", turn.as_matrix(), place)


def depth_files(recording: Path, name: str) -> list[tuple[int, Float64]]:
    files = sorted((recording / "truth").glob(f"depth_{name}_*.npz"))
    return [(int(f.stem.split("_")[-1]), np.load(f)["z"].astype(np.float64)) for f in files]


def test_files_and_keys_are_those_of_the_contract(recording: Path) -> None:
    names = {str(p.relative_to(recording)) for p in recording.rglob("*") if p.is_file()}
    for sensor in ("cam0", "cam1", "imu0", "crane0", "laser0"):
        assert {f"mav0/{sensor}/data.csv", f"mav0/{sensor}/sensor.yaml"} <= names
    assert {"mav0/state_groundtruth_estimate0/data.csv", "truth/height.npz", "truth/bundles.json"} <= names
    assert yaml.safe_load((recording / "mav0/body.yaml").read_text())["is_simulated"] is True
    truth = np.load(recording / "truth/height.npz")
    wanted = {"x", "y", "z", "visible", "profile_x", "profile_ys"}
    wanted |= {f"profile_{what}{k}" for what in ("y", "visible") for k in (0, 1)}
    assert set(truth) == wanted
    assert truth["z"].shape == truth["visible"].shape == (len(truth["x"]), len(truth["y"]))
    bundle = json.loads((recording / "truth/bundles.json").read_text())[0]
    assert {"center", "yaw_deg", "bundle_radius", "bar_diameter", "length", "top_z", "on_top"} <= set(bundle)
    rig = json.loads((recording / "truth/rig.json").read_text())
    assert {"gyro_bias0", "accel_bias0", "T_BC0", "T_C0C1", "time_offset_s", "lever", "args"} == set(rig)
    stamps = [line.split(",")[0] for line in (recording / "mav0/cam0/data.csv").read_text().split()[2:]]
    assert len([s for s in stamps if s.isdigit()]) == SMALL.frames
    for name in ("cam0", "cam1"):
        images = sorted((recording / f"mav0/{name}/data").glob("*.png"))
        assert len(images) == SMALL.frames
        assert cv2.imread(str(images[0]), cv2.IMREAD_UNCHANGED).shape == (256, 320)
        assert len(depth_files(recording, name)) == SMALL.depth_views


@pytest.mark.parametrize("name", ["cam0", "cam1"])
def test_true_depth_lies_on_the_true_surface(recording: Path, name: str) -> None:
    camera, body_from_cam = read_camera(recording, name)
    scene = World.build(SMALL).scene
    v, u = np.meshgrid(np.arange(256.0), np.arange(320.0), indexing="ij")
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    for stamp, depth in depth_files(recording, name):
        yard_from_cam = true_pose(recording, stamp) @ Pose(
            "body", "cam", body_from_cam.rotation, body_from_cam.translation
        )
        points = yard_from_cam.apply(rays * depth.reshape(-1, 1))
        surface = heights(scene, points[:, 0], points[:, 1])
        # On an upright face, rounding puts some points a hair outside, over the floor beside it.
        assert (points[:, 2] - surface > 1e-4).mean() < 5e-3
        on_top = np.abs(points[:, 2] - surface) < 1e-3
        assert on_top.mean() > 0.75
        assert np.median(np.abs(points[on_top, 2] - surface[on_top])) < 2e-5


def test_laser_and_profiles_are_the_height_of_the_surface(recording: Path) -> None:
    truth = np.load(recording / "truth/height.npz")
    scene = World.build(SMALL).scene
    rows = np.loadtxt(recording / "mav0/laser0/data.csv", delimiter=",", comments="#")
    for k, y in enumerate(truth["profile_ys"]):
        exact = heights(scene, truth["profile_x"], np.full(len(truth["profile_x"]), y))
        np.testing.assert_allclose(truth[f"profile_y{k}"], exact, atol=1e-6)
        mine = rows[rows[:, 0] == k]
        np.testing.assert_allclose(mine[:, 1], truth["profile_x"], atol=1e-9)
        assert (mine[:, 3] - exact).std() == pytest.approx(0.001, rel=0.2)


def test_visible_cells_are_those_whose_depth_agrees(recording: Path) -> None:
    """A cell that every frame sees must show its own depth in the depth truth, but at steps."""
    truth = np.load(recording / "truth/height.npz")
    gx, gy = np.meshgrid(truth["x"], truth["y"], indexing="ij")
    points = np.stack([gx, gy, truth["z"].astype(np.float64)], axis=2)
    visible = truth["visible"]
    assert 0 < visible.max() <= SMALL.frames
    camera, body_from_cam = read_camera(recording, "cam0")
    for stamp, depth in depth_files(recording, "cam0"):
        cam_from_yard = (true_pose(recording, stamp) @ body_from_cam).inverse()
        seen_always = points[visible == SMALL.frames]
        in_camera = cam_from_yard.apply(seen_always)
        pixels = np.rint(camera.project(in_camera)).astype(int)
        assert (pixels >= -1).all()
        assert (pixels <= (320, 256)).all()
        inside = (pixels >= 0).all(axis=1) & (pixels < (320, 256)).all(axis=1)
        there = depth[pixels[inside, 1], pixels[inside, 0]]
        assert (np.abs(there - in_camera[inside, 2]) < 0.03).mean() > 0.9


def test_both_pictures_show_the_same_surface(recording: Path) -> None:
    """Warped through the true depth, cam1 matches cam0 best without a shift, to a twentieth of a pixel."""
    (cam0, body_from_cam0), (cam1, body_from_cam1) = (read_camera(recording, n) for n in ("cam0", "cam1"))
    place = body_from_cam1.inverse() @ body_from_cam0
    v, u = np.meshgrid(np.arange(256.0), np.arange(320.0), indexing="ij")
    rays = cam0.rays(np.column_stack([u.ravel(), v.ravel()]))
    for stamp, depth in depth_files(recording, "cam0"):
        left, right = (
            cv2.imread(str(recording / f"mav0/{n}/data/{stamp}.png"), cv2.IMREAD_UNCHANGED).astype(np.float32)
            for n in ("cam0", "cam1")
        )
        match = cam1.project(place.apply(rays * depth.reshape(-1, 1))).astype(np.float32).reshape(256, 320, 2)
        edges = cv2.dilate(depth.astype(np.float32), np.ones((5, 5))) - cv2.erode(
            depth.astype(np.float32), np.ones((5, 5))
        )
        fit = (match[..., 0] > 4) & (match[..., 0] < 315) & (match[..., 1] > 4) & (match[..., 1] < 251)
        floor = fit & (edges < 0.02)
        shifts = np.linspace(-1, 1, 21)
        cost = [
            np.square(
                cv2.remap(right, match[..., 0] + np.float32(s), match[..., 1], cv2.INTER_CUBIC)
                / SMALL.camera.cam1_gain
                - left
            )[floor].mean()
            for s in shifts
        ]
        best = int(np.argmin(cost))
        assert 0 < best < 20
        a, b, c = cost[best - 1 : best + 2]
        assert abs(shifts[best] + 0.05 * (a - c) / (a - 2 * b + c)) < 0.05


def digest(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def test_same_seed_same_bytes_other_seed_other_yard(recording: Path, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    simulate(tmp_path / "again", SMALL, lambda done, total: calls.append((done, total)))
    assert calls == [(k + 1, SMALL.frames) for k in range(SMALL.frames)]
    assert digest(tmp_path / "again") == digest(recording)
    other = stack_yard(replace(SMALL, seed=12), np.random.default_rng((12, 0)))
    assert [b.centre_m.tolist() for b in other.bundles] != [
        b.centre_m.tolist() for b in stack_yard(SMALL, np.random.default_rng((11, 0))).bundles
    ]


def test_recordings_of_one_crane_have_its_rig() -> None:
    def rig(seed: int, rig_seed: int | None) -> list[float]:
        given = SimulationSettings(seed=seed, camera=CameraSettings(rig_seed=rig_seed))
        mounted = mount_rig(given, np.random.default_rng(seed))
        return [*mounted.rig.body_from_cam1.rotation.ravel(), mounted.rig.cam0.cx_px]

    assert rig(1, 5) == rig(2, 5) != rig(1, 6)
    assert rig(1, None) != rig(2, None)


def test_an_interruption_leaves_nothing(tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(tmp_path / "out", SMALL, stop)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("kept")
    with pytest.raises(OutputError, match="not empty"):
        simulate(tmp_path, SMALL)
    assert (tmp_path / "mine").read_text() == "kept"


def x_at(bundle: StackedBundle, y: float) -> float:
    return float(bundle.centre_m[0] - np.tan(bundle.yaw_rad) * (y - bundle.centre_m[1]))


@pytest.mark.parametrize("bars", ["90mm:7", "40mm:37", "30mm:61,50mm:19", "200mm:1"])
def test_bars_lie_beside_and_above_each_other(bars: str) -> None:
    """No bar enters another, none the floor: distances of axes at both ends and the middle."""
    settings = SimulationSettings(length_m=5, seed=2, bars=bars)
    stock = stack_yard(settings, np.random.default_rng(2))
    assert {b.kind for b in stock.bundles} <= set(settings.kinds)
    by_layer: dict[Any, list[Any]] = {}
    for bundle in stock.bundles:
        assert len(bundle.cross_m) == bundle.kind.count
        assert abs(bundle.yaw_rad) <= np.radians(1) + 1e-12
        gaps = np.linalg.norm(bundle.cross_m[:, None] - bundle.cross_m[None], axis=2)
        assert (gaps[~np.eye(len(gaps), dtype=bool)] >= bundle.kind.diameter_m - 1e-9).all()
        bottom = bundle.centre_m[2] + bundle.cross_m[:, 1].min() - bundle.kind.diameter_m / 2
        assert bottom >= settings.yard.dunnage_m - 1e-9
        by_layer.setdefault((bundle.section, bundle.layer), []).append(bundle)
    for bundles in by_layer.values():
        for one, other in itertools.pairwise(bundles):
            for y in np.array([-0.5, 0.0, 0.5]) * one.length_m:
                apart = x_at(other, y) - x_at(one, y)
                assert apart > one.radius_m + other.radius_m
    for (section, layer), bundles in by_layer.items():
        above = by_layer.get((section, layer + 1), [])
        for bundle in above:
            lowest = bundle.centre_m[2] + bundle.cross_m[:, 1].min() - bundle.kind.diameter_m / 2
            assert lowest >= max(b.top_z_m for b in bundles) + settings.yard.dunnage_m - 1e-9


def test_nothing_lies_over_what_lies_on_top() -> None:
    """A bundle is free where no other of its section hides 20 mm of it from above, along all of it."""
    for seed, yard in ((3, YardSettings(max_layers=3, skew_deg=1.5)), (4, YardSettings(crossed_ratio=1.0))):
        stock = stack_yard(replace(SMALL, length_m=8, yard=yard), np.random.default_rng(seed))
        for one in stock.bundles:
            covered = False
            for other in stock.bundles:
                if other.section != one.section or other.layer <= one.layer:
                    continue
                along = np.linspace(-0.5, 0.5, 400) * other.length_m
                for u in (np.linspace(-0.5, 0.5, 40) * (other.width_m - 0.02)).tolist():
                    at = other.centre_m + u * other.axes[0] + along[:, None] * other.axes[1] - one.centre_m
                    beside = np.abs(at @ one.axes[0]) < one.width_m / 2 - 0.01
                    covered |= bool((beside & (np.abs(at @ one.axes[1]) < one.length_m / 2 - 0.01)).any())
            assert covered is not one.on_top


def test_top_z_is_the_height_of_the_surface_there() -> None:
    settings = replace(SMALL, yard=YardSettings(max_layers=3, strap_spacing_m=0))
    stock = stack_yard(settings, np.random.default_rng(1))
    scene = build_scene(stock, settings, np.random.default_rng(1))
    tops = [b for b in stock.bundles if b.on_top]
    assert tops
    for bundle in tops:
        y = bundle.centre_m[1] + 0.6
        x = bundle.centre_m[0] - np.tan(bundle.yaw_rad) * 0.6 + np.linspace(-0.14, 0.14, 400)
        highest = heights(scene, x, np.full(400, y)).max()
        assert highest == pytest.approx(bundle.top_z_m, abs=2e-4)


def test_bars_are_read_from_text() -> None:
    assert parse_bars("90mm:7, 40mm:37") == (BarKind(0.09, 7), BarKind(0.04, 37))


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: SimulationSettings(bars="90:7"), "90mm:7"),
        (lambda: SimulationSettings(bars="90mm:8"), "7, 19"),
        (lambda: SimulationSettings(bars="900mm:7"), "500 mm"),
        (lambda: SimulationSettings(length_m=0.2), "length_m"),
        (lambda: SimulationSettings(frames=1), "frames"),
        (lambda: SimulationSettings(camera=CameraSettings(above_floor_m=2)), "above_floor_m"),
        (lambda: CameraSettings(width_px=10), "camera.width_px must lie in 64"),
        (lambda: YardSettings(max_layers=9), "max_layers"),
        (lambda: TravelSettings(speed_mps=0), "speed_mps"),
        (lambda: SensorSettings(timeshift_cam_imu_s=2), "timeshift"),
        (lambda: SensorSettings(imu_rate_hz=1), "imu_rate_hz"),
    ],
)
def test_settings_out_of_range_are_refused_in_one_line(make: Any, match: str) -> None:
    with pytest.raises(ConfigError, match=match) as caught:
        make()
    assert "\n" not in str(caught.value)
