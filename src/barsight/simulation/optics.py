"""Model the cameras: the rig, each raw pixel's ray through the distorted lens, and the image sensor."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float32, Float64, UInt8
from barsight.core.pose import Pose
from barsight.core.stamps import seconds_to_ns
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings

LATTICE_PX = 8
WHITE_DN = 215.0
"""Gray level of radiance 1 in cam0, before clipping."""


@dataclass(frozen=True, eq=False)
class MountedRig:
    """The rig, and the body's attitude (3, 3) while nothing sways."""

    rig: StereoRig
    nominal_yard_from_body: Float64


def mount_rig(settings: SimulationSettings, rng: np.random.Generator) -> MountedRig:
    """Mount cam0 looking down (apart from the tilt) with its rows along X (apart from the heading). The
    mounting angles are random; their seed is the rig's own if it has one.
    """
    camera = settings.camera
    if camera.rig_seed is not None:
        rng = np.random.default_rng(camera.rig_seed)
    spread = np.radians(camera.misalignment_deg)
    crooked = Rotation.from_rotvec(rng.normal(0, 2 * spread, 3)).as_matrix()
    body_from_cam0 = Pose(
        "body", "cam0", _BODY_FROM_CAM @ crooked, np.array([0.06 - camera.aside_m, -0.09, 0.04])
    )
    turned = Rotation.from_rotvec(rng.normal(0, spread, 3)).as_matrix()
    offset = np.array([0.0, *rng.normal(0, 0.001, 2)])
    offset[0] = np.sqrt(camera.baseline_m**2 - offset @ offset)
    cam0_from_cam1 = Pose("cam0", "cam1", turned, offset)
    middle = np.array([(camera.width_px - 1) / 2, (camera.height_px - 1) / 2])
    spots = middle + rng.uniform(-0.008, 0.008, (2, 2)) * camera.width_px
    rig = StereoRig(
        _camera(camera, camera.focal_px, spots[0]),
        _camera(camera, 1.002 * camera.focal_px, spots[1]),
        body_from_cam0,
        body_from_cam0 @ cam0_from_cam1,
        seconds_to_ns(settings.sensors.timeshift_cam_imu_s),
    )
    looking_down = Rotation.from_euler("ZX", [camera.heading_deg, 180 + camera.tilt_deg], degrees=True)
    return MountedRig(rig, looking_down.as_matrix() @ body_from_cam0.rotation.T)


_BODY_FROM_CAM = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _camera(settings: CameraSettings, focal: float, spot: Float64) -> Camera:
    coefficients = tuple(float(c) for c in settings.distortion)
    cx, cy = (round(float(c), 1) for c in spot)
    return Camera(
        settings.width_px, settings.height_px, focal, focal, cx, cy, Distortion.RADTAN, coefficients
    )


def sample_rays(camera: Camera, side: int) -> Float32:
    """Compute x and y (side H, side W, 2) of the directions, with z = 1, of side^2 samples in each raw pixel.

    The lens is inverted on a lattice of 8 px and interpolated by cubic splines, to 1e-4 px.
    """
    lattice_u = np.arange(-LATTICE_PX, camera.width + 2 * LATTICE_PX, LATTICE_PX, dtype=np.float64)
    lattice_v = np.arange(-LATTICE_PX, camera.height + 2 * LATTICE_PX, LATTICE_PX, dtype=np.float64)
    u, v = np.meshgrid(lattice_u, lattice_v)
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 3)
    fine_u = (np.arange(side * camera.width) + 0.5) / side - 0.5
    fine_v = (np.arange(side * camera.height) + 0.5) / side - 0.5
    out = np.empty((len(fine_v), len(fine_u), 2), dtype=np.float32)
    for k in range(2):
        out[..., k] = RectBivariateSpline(lattice_v, lattice_u, rays[..., k])(fine_v, fine_u)
    return out


def vignette(camera: Camera, loss: float) -> Float32:
    """Compute the vignetting factor (H, W) of each pixel, 1 - loss in the farthest corner."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    square = ((u - camera.cx_px) ** 2 + (v - camera.cy_px) ** 2).astype(np.float32)
    share: Float32 = (1 - loss * square / square.max()).astype(np.float32)
    return share


def expose(
    radiance: Float32, share: Float32, gain: float, settings: CameraSettings, rng: np.random.Generator
) -> UInt8:
    """Simulate the sensor: blur, vignetting, gain, shot and read noise, 8 bits."""
    sigma = settings.psf_sigma_px
    blurred = (
        cv2.GaussianBlur(radiance, (5, 5), sigma, borderType=cv2.BORDER_REPLICATE) if sigma > 0 else radiance
    )
    signal = blurred * share * np.float32(gain * WHITE_DN)
    noise = rng.standard_normal(signal.shape, dtype=np.float32)
    noise *= np.sqrt(settings.shot_noise_dn**2 * signal + settings.read_noise_dn**2, dtype=np.float32)
    gray: UInt8 = np.clip(np.rint(signal + noise), 0, 255).astype(np.uint8)
    return gray
