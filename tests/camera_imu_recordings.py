"""Simulated camera-IMU recordings with known truth: a rig waved in front of an AprilGrid."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.board import Board, parse_board
from barsight.calibration.boards.board_views import BoardView, Corners
from barsight.calibration.files.euroc import write_imu_description, write_rig
from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import ImuSamples
from barsight.simulation.boards.drawing import draw_board

SIZE = (752, 480)
BOARD = parse_board("aprilgrid:6x6:0.088:0.3")
NOISE = ImuNoise(1.7e-4, 1.9e-5, 2.0e-3, 3.0e-3, 200.0)
CAM0 = Camera(*SIZE, 458, 457, 367, 248, Distortion.RADTAN, (-0.28, 0.07, 2e-4, 1e-5))
CAM1 = Camera(*SIZE, 457, 456, 380, 255, Distortion.RADTAN, (-0.28, 0.07, -1e-4, -4e-5))
START_NS = 1_404_733_405_732_800_000


@dataclass
class Truth:
    """body_from_cam0, body_from_cam1; shift_s per camera; gravity in the board's frame."""

    rig: StereoRig
    shift_s: tuple[float, float]
    gravity: np.ndarray


def true_rig() -> StereoRig:
    first = Rotation.from_euler("zyx", [89, 1.5, -0.4], degrees=True)
    body_from_cam0 = Pose("body", "cam0", first.as_matrix(), np.array([-0.0216, -0.0647, 0.0098]))
    turn = Rotation.from_rotvec([0.007, -0.014, 0.002]).as_matrix()
    cam0_from_cam1 = Pose("cam0", "cam1", turn, np.array([0.11, -0.0005, 0.001]))
    return StereoRig(CAM0, CAM1, body_from_cam0, body_from_cam0 @ cam0_from_cam1)


class Way:
    """world_from_body as smooth functions of time: sums of sines about a pose that sees the board."""

    def __init__(self, rng: np.random.Generator, body_from_cam0: Pose, swing: float = 1.0) -> None:
        self.frequency = 2 * np.pi * rng.uniform(0.15, 1.1, (2, 4, 3))
        self.phase = rng.uniform(0, 2 * np.pi, (2, 4, 3))
        size = np.array([0.16, 0.07])[:, None, None] * swing
        self.size = size * rng.uniform(0.5, 1.0, (2, 4, 3)) / (0.5 + self.frequency / 4)
        centre = BOARD.points_m.mean(axis=0)
        look = np.diag([1.0, -1.0, -1.0])  # the camera looks along the board's -z
        self.base = look @ body_from_cam0.rotation.T
        self.place = centre + np.array([0.0, 0.0, 0.85])

    def waves(self, kind: int, t: np.ndarray, derivative: int) -> np.ndarray:
        angle = self.frequency[kind] * t[:, None, None] + self.phase[kind] + derivative * np.pi / 2
        return (self.size[kind] * self.frequency[kind] ** derivative * np.sin(angle)).sum(axis=1)

    def rotation(self, t: np.ndarray) -> np.ndarray:
        return self.base @ Rotation.from_rotvec(self.waves(0, t, 0)).as_matrix()

    def rate(self, t: np.ndarray) -> np.ndarray:
        v, slope = self.waves(0, t, 0), self.waves(0, t, 1)
        angle = np.linalg.norm(v, axis=1)[:, None]
        a, b = (1 - np.cos(angle)) / angle**2, (1 - np.sin(angle) / angle) / angle**2
        once = np.cross(v, slope)
        return slope - a * once + b * np.cross(v, once)


def simulated(
    seed: int, seconds: float = 6.0, corner_px: float = 0.25, swing: float = 1.0,
    shift_s: tuple[float, float] = (0.0031, 0.0026), noise: ImuNoise = NOISE,
    gyro_scale: float = 1.0, camera_hz: float = 20.0, one_axis: bool = False, board: Board = BOARD,
) -> tuple[list[BoardView], ImuSamples, Truth]:  # fmt: skip
    """Views named by their stamps, the IMU's samples, the truth. The IMU covers 0.2 s more at each end."""
    rng = np.random.default_rng(seed)
    rig = true_rig()
    way = Way(rng, rig.body_from_cam0, swing)
    if one_axis:
        way.size[0, :, 1:] = 0.0
        way.size[1] *= 0.05
    gravity = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).apply([0.0, -9.80665, 0.0])
    step_ns = int(1e9 / noise.rate_hz)
    stamps = START_NS - 200_000_000 + np.arange(int((seconds + 0.4) * noise.rate_hz)) * step_ns
    t = (stamps - START_NS) / 1e9
    rate = way.rate(t) * gyro_scale
    force = np.einsum("nji,nj->ni", way.rotation(t), way.waves(1, t, 2) - gravity)
    spread = np.sqrt(noise.rate_hz)
    walk = np.cumsum(rng.normal(0, 1, (2, t.size, 3)), axis=1) / spread
    gyro = rate + 0.05 + noise.gyro_walk * walk[0] + rng.normal(0, noise.gyro_density * spread, rate.shape)
    accel = force + 0.1 + noise.accel_walk * walk[1] + rng.normal(0, noise.accel_density * spread, rate.shape)
    views = []
    for number in range(int(seconds * camera_hz)):
        stamp = START_NS + int(number * 1e9 / camera_hz)
        seen = []
        for camera, mount, shift in (
            (rig.cam0, rig.body_from_cam0, shift_s[0]), (rig.cam1, rig.body_from_cam1, shift_s[1]),
        ):  # fmt: skip
            at = np.array([(stamp - START_NS) / 1e9 + shift])
            place = way.place + way.waves(1, at, 0)[0]
            points = mount.inverse().apply((board.points_m - place) @ way.rotation(at)[0])
            plane = points[:, :2] / np.maximum(points[:, 2:], 0.01)
            ahead = np.flatnonzero((points[:, 2] > 0.05) & (np.abs(plane).max(axis=1) < 1.2))
            pixels = camera.project(points[ahead])
            inside = ((pixels > 3) & (pixels < np.array(SIZE) - 4)).all(axis=1)
            noisy = pixels[inside] + rng.normal(0, corner_px, (int(inside.sum()), 2))
            seen.append(Corners(ahead[inside], noisy) if inside.sum() >= 8 else None)
        if seen != [None, None]:
            views.append(BoardView(str(stamp), seen[0], seen[1]))
    return views, ImuSamples(stamps, gyro, accel), Truth(rig, shift_s, gravity)


def without_extrinsics(rig: StereoRig) -> StereoRig:
    """The rig as a stereo calibration leaves it: the body is cam0."""
    identity = Pose.identity("body", "cam0")
    return replace(rig, body_from_cam0=identity, body_from_cam1=identity @ rig.cam0_from_cam1)


def draw_recording(folder: Path, seconds: float = 4.0) -> StereoRig:
    """An EuRoC folder of pictures of the board, drawn through ideal lenses; returns the true rig."""
    rig = true_rig()
    ideal = [replace(camera, distortion=Distortion.NONE, coefficients=()) for camera in (rig.cam0, rig.cam1)]
    rig = replace(rig, cam0=ideal[0], cam1=ideal[1])
    _, imu, _ = simulated(2, seconds, shift_s=(0.0, 0.0))
    way = Way(np.random.default_rng(2), rig.body_from_cam0)
    px_per_m, margin_m = 1250.0, 0.1
    picture = cv2.GaussianBlur(draw_board(BOARD, px_per_m, margin_m), (0, 0), 1.2)
    low = margin_m * px_per_m - 0.5
    high = picture.shape[0] - 1 - low
    board_from_drawn = np.linalg.inv([[px_per_m, 0, low], [0, -px_per_m, high], [0, 0, 1]])
    stamps = [START_NS + k * 50_000_000 for k in range(int(seconds * 20))]
    for name, camera, mount in (
        ("cam0", rig.cam0, rig.body_from_cam0), ("cam1", rig.cam1, rig.body_from_cam1),
    ):  # fmt: skip
        (folder / "mav0" / name / "data").mkdir(parents=True)
        lines = ["#timestamp [ns],filename"]
        for stamp in stamps:
            at = np.array([(stamp - START_NS) / 1e9])
            body_from_board = way.rotation(at)[0].T
            turn = mount.rotation.T @ body_from_board
            place = way.place + way.waves(1, at, 0)[0]
            shift = mount.rotation.T @ (-body_from_board @ place - mount.translation)
            homography = camera.matrix @ np.column_stack([turn[:, 0], turn[:, 1], shift]) @ board_from_drawn
            image = cv2.warpPerspective(picture, homography, SIZE, borderValue=128)
            cv2.imwrite(str(folder / "mav0" / name / "data" / f"{stamp}.png"), image)
            lines.append(f"{stamp},{stamp}.png")
        (folder / "mav0" / name / "data.csv").write_text("\n".join(lines) + "\n")
    write_rig(folder / "mav0", without_extrinsics(rig), 20.0)
    (folder / "mav0" / "imu0").mkdir()
    write_imu_description(folder / "mav0" / "imu0" / "sensor.yaml", NOISE, 200.0)
    rows = [
        f"{stamp}," + ",".join(f"{value:.9g}" for value in (*gyro, *accel))
        for stamp, gyro, accel in zip(imu.stamp_ns, imu.gyro_radps, imu.accel_mps2, strict=True)
    ]
    (folder / "mav0" / "imu0" / "data.csv").write_text("#timestamp,w,w,w,a,a,a\n" + "\n".join(rows) + "\n")
    return rig
