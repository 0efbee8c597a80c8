"""Write the exact truth with a recording: heights, visibility, depth of some views, bundles, rig."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Bool, Float32, Float64
from barsight.core.pose import Pose
from barsight.simulation.hanging_plate import MagnetPlate
from barsight.simulation.optics import sample_rays
from barsight.simulation.rays import cast_rays
from barsight.simulation.scene import CODE, Scene
from barsight.simulation.sensors import heights
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.stock import StackedBundle
from barsight.simulation.textures import label_text

CELL_X_M, CELL_Y_M = 0.01, 0.02
HALF_WIDTH_M = 3.8
PROFILE_STEP_M = 0.01
OCCLUSION_M = 0.001


class SurfaceTruth:
    """Height map, laser profiles, and the number of frames in which both cameras see each of their points.

    x_m (X,), y_m (Y,), z_m (X, Y), visible (X, Y); profile_x_m (N,), profile_z_m and profile_visible (K, N).
    """

    def __init__(self, scene: Scene, settings: SimulationSettings) -> None:
        length = settings.length_m
        self.x_m = np.round(-0.5 + CELL_X_M * np.arange(round((length + 1) / CELL_X_M)), 4)
        self.y_m = np.round(-HALF_WIDTH_M + CELL_Y_M * np.arange(round(2 * HALF_WIDTH_M / CELL_Y_M)), 4)
        self.profile_x_m = np.round(
            -0.3 + PROFILE_STEP_M * np.arange(round((length + 0.6) / PROFILE_STEP_M)), 4
        )
        self.profile_y_m = np.array(settings.sensors.laser_y_m, dtype=np.float64)
        shape = (len(self.x_m), len(self.y_m))
        gx, gy = np.meshgrid(self.x_m, self.y_m, indexing="ij")
        px, py = np.meshgrid(self.profile_x_m, self.profile_y_m)
        self._scene = scene
        x = np.concatenate([gx.ravel(), px.ravel()])
        y = np.concatenate([gy.ravel(), py.ravel()])
        self._points = np.column_stack([x, y, heights(scene, x, y)])
        self._seen = np.zeros(len(self._points), dtype=np.int16)
        self.z_m = self._points[: gx.size, 2].reshape(shape)
        self.visible = self._seen[: gx.size].reshape(shape)
        self.profile_z_m = self._points[gx.size :, 2].reshape(px.shape)
        self.profile_visible = self._seen[gx.size :].reshape(px.shape)

    def count_frame(self, rig: StereoRig, yard_from_body: Pose, plate: MagnetPlate | None = None) -> None:
        """Increment the count of every point that both cameras see in this frame."""
        low, high = _floor_reach(rig.cam0, yard_from_body @ rig.body_from_cam0)
        rows = np.flatnonzero((self._points[:, 0] >= low) & (self._points[:, 0] <= high))
        for camera, mounting in ((rig.cam0, rig.body_from_cam0), (rig.cam1, rig.body_from_cam1)):
            yard_from_cam = yard_from_body @ mounting
            rows = rows[self._sees(camera, yard_from_cam, self._points[rows])]
            if plate is not None:
                origin = yard_from_cam.translation
                hit, share, _ = plate.covers(origin, self._points[rows] - origin)
                rows = rows[~(hit & (share < 1))]
        self._seen[rows] += 1

    def _sees(self, camera: Camera, yard_from_cam: Pose, points: Float64) -> Bool:
        """Check which points (N,) a camera sees: inside its image, and not occluded."""
        in_camera = yard_from_cam.inverse().apply(points)
        plane = in_camera[:, :2] / in_camera[:, 2:]
        limit = 0.75 * np.hypot(camera.width, camera.height) / camera.fx_px
        seen: Bool = (in_camera[:, 2] > 0.05) & ((plane**2).sum(axis=1) < limit**2)
        pixels = camera.project(in_camera[seen])
        inside = (pixels >= -0.5).all(axis=1) & (pixels < (camera.width - 0.5, camera.height - 0.5)).all(
            axis=1
        )
        seen[seen] = inside
        sight = points[seen] - yard_from_cam.translation
        share, _ = cast_rays(self._scene, yard_from_cam.translation[None], sight)
        seen[seen] = (1 - share) * np.linalg.norm(sight, axis=1) < OCCLUSION_M
        return seen

    def write(self, folder: Path) -> None:
        """Write `height.npz`."""
        arrays: dict[str, Any] = {"x": self.x_m, "y": self.y_m, "z": self.z_m.astype(np.float32)}
        arrays |= {"visible": self.visible, "profile_x": self.profile_x_m, "profile_ys": self.profile_y_m}
        for k in range(len(self.profile_y_m)):
            arrays[f"profile_y{k}"] = self.profile_z_m[k].astype(np.float32)
            arrays[f"profile_visible{k}"] = self.profile_visible[k]
        np.savez_compressed(folder / "height.npz", **arrays)


def _floor_reach(camera: Camera, yard_from_cam: Pose) -> tuple[float, float]:
    """Compute bounds in x (m), with a margin, of a camera's view of the yard; infinite near the horizon."""
    half = 0.65 * np.array([camera.width / camera.fx_px, camera.height / camera.fy_px])
    corners = [[i * half[0], j * half[1], 1.0] for i in (-1, 1) for j in (-1, 1)]
    rays = np.array(corners) @ yard_from_cam.rotation.T
    if rays[:, 2].max() > -0.05:
        return -np.inf, np.inf
    x, _, z = yard_from_cam.translation
    reached = np.append(x - rays[:, 0] / rays[:, 2] * z, x)
    return float(reached.min()), float(reached.max())


def true_depth(
    scene: Scene, camera: Camera, yard_from_cam: Pose, plate: MagnetPlate | None = None
) -> Float32:
    """Compute depth (H, W), m, along the raw camera's optical axis at pixel centres; inf without a hit."""
    plane = sample_rays(camera, 1).reshape(-1, 2).astype(np.float64)
    directions = np.column_stack([plane, np.ones(len(plane))]) @ yard_from_cam.rotation.T
    depth, _ = cast_rays(scene, yard_from_cam.translation[None], directions)
    if plate is not None:
        hit, share, _ = plate.covers(yard_from_cam.translation, directions)
        depth = np.where(hit, np.minimum(depth, share), depth)
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def bundle_rows(bundles: tuple[StackedBundle, ...]) -> list[dict[str, Any]]:
    """Describe stacked bundles in the format of `bundles.json`."""
    return [
        {
            "sec": b.section, "lay": b.layer, "col": b.column, "center": b.centre_m.tolist(),
            "yaw_deg": float(np.degrees(b.yaw_rad)), "bundle_radius": b.radius_m,
            "bar_diameter": b.kind.diameter_m, "bars": b.kind.count, "length": b.length_m,
            "top_z": b.top_z_m, "on_top": b.on_top,
        }
        for b in bundles
    ]  # fmt: skip


def label_rows(scene: Scene, seed: int) -> list[dict[str, Any]]:
    """Describe the labels: text, and centre of the paper in the yard, m."""
    shape, material, cylinders = scene.primitives
    boxes = np.arange(cylinders, len(shape))
    return [
        {"text": label_text(seed, int(material[p, CODE])), "center": shape[p, :3].tolist()}
        for p in boxes[material[boxes, CODE] > 0]
    ]


def write_rig_truth(
    rig: StereoRig, gyro_bias: Float64, accel_bias: Float64, lever_m: Float64, settings: SimulationSettings,
    folder: Path,
) -> None:  # fmt: skip
    """Write `rig.json`, the true calibration, biases and lever arm."""
    content = {
        "gyro_bias0": gyro_bias.tolist(),
        "accel_bias0": accel_bias.tolist(),
        "T_BC0": rig.body_from_cam0.matrix.tolist(),
        "T_C0C1": rig.cam0_from_cam1.matrix.tolist(),
        "time_offset_s": settings.sensors.timeshift_cam_imu_s,
        "lever": lever_m.tolist(),
        "args": asdict(settings),
    }
    (folder / "rig.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
