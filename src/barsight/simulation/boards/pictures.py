"""Photograph a calibration board with the simulated rig: image pairs as an engineer would take them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.board import Board
from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float32, Float64
from barsight.core.errors import ConfigError
from barsight.core.files import atomic_directory
from barsight.core.pose import Pose
from barsight.simulation.boards.drawing import draw_board
from barsight.simulation.optics import expose, mount_rig, sample_rays, vignette
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import stream

SHARES = 0.2, 0.75
"""Smallest and largest share of the image width that the board covers."""
TILT_DEG, ROLL_DEG = 40.0, 12.0
MARGIN_PX = 6.0
SIDE_PX = 150
"""Side of a drawn square or tag, px; a multiple of ten, so that gaps of tenths of it are whole too."""
TRIES = 2000
DARK, BRIGHT, BEHIND = 0.08, 0.75, 0.3
"""Radiance of the board's ink, of its paper, and of the background."""


def photograph_board(
    out: Path, board: Board, views: int, settings: SimulationSettings,
    progress: Callable[[int, int], None] | None = None,
) -> None:  # fmt: skip
    """Write images of a board, fully visible in both cameras, to the new folder `out`: left/ and right/, one
    PNG per view, named by its number.

    The rig is that of `simulate` with the same settings. progress: called with (pairs written, total pairs).
    Raises ConfigError if the board can't be fully visible in both cameras.
    """
    rig, rng = mount_rig(settings, stream(settings, 2)).rig, stream(settings, 15)
    sheet = _Sheet(board)
    cameras = (("left", rig.cam0, 1.0), ("right", rig.cam1, settings.camera.cam1_gain))
    side = max(settings.camera.samples_per_side, 3)
    rays = [sample_rays(camera, side) for _, camera, _ in cameras]
    shares = [vignette(camera, settings.camera.vignetting) for _, camera, _ in cameras]
    with atomic_directory(out) as folder:
        for name in ("left", "right"):
            (folder / name).mkdir()
        for view in range(views):
            held = _held(sheet, rig, rng)
            poses = held, rig.cam0_from_cam1.inverse() @ held
            for k, (name, _, gain) in enumerate(cameras):
                seen, noise = sheet.seen(poses[k], rays[k], side), stream(settings, 16, view, k)
                picture = expose(seen, shares[k], gain, settings.camera, noise)
                (folder / name / f"{view:02}.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())
            if progress is not None:
                progress(view + 1, views)


class _Sheet:
    """The printed board. Its frame: origin at the centre, x right, y down, z away from the viewer."""

    def __init__(self, board: Board) -> None:
        self._px_per_m = SIDE_PX / board.size_m
        self._drawn = draw_board(board, self._px_per_m, board.size_m).astype(np.float32) / 255
        height, width = self._drawn.shape
        self.size_m = np.array([width, height]) / self._px_per_m

    @property
    def corners_m(self) -> Float64:
        """Return the corners of the paper (4, 3), m."""
        x, y = self.size_m / 2
        return np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])

    def seen(self, pose: Pose, rays: Float32, side: int) -> Float32:
        """Render the radiance (H, W) that a camera receives with the board at `pose`, camera from board."""
        normal = pose.rotation[:, 2]
        directions = np.dstack([rays, np.ones(rays.shape[:2], np.float32)])
        depth = (pose.translation @ normal) / (directions @ normal)
        at = (directions * depth[..., None] - pose.translation) @ pose.rotation[:, :2]
        coarser = self._px_per_m * float(np.linalg.norm(np.diff(at, axis=1), axis=2).min())
        drawn = self._drawn
        if coarser > 1:  # anti-aliasing: a ray samples the mean of its surroundings
            size = np.ceil(np.array(drawn.shape[::-1]) / coarser).astype(int)
            drawn = cv2.resize(drawn, size.tolist(), interpolation=cv2.INTER_AREA)
        place = ((at / self.size_m + 0.5) * drawn.shape[::-1] - 0.5).astype(np.float32)
        ink = cv2.remap(
            drawn, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
            borderValue=-1,
        )  # fmt: skip
        radiance = np.where(ink < 0, BEHIND, DARK + (BRIGHT - DARK) * ink).astype(np.float32)
        height, width = radiance.shape[0] // side, radiance.shape[1] // side
        mean: Float32 = radiance.reshape(height, side, width, side).mean(axis=(1, 3))
        return mean


def _held(sheet: _Sheet, rig: StereoRig, rng: np.random.Generator) -> Pose:
    """Draw a random pose of the board, near or far, tilted, and fully visible in both cameras."""
    left = rig.cam0
    for _ in range(TRIES):
        depth = left.fx_px * sheet.size_m[0] / (rng.uniform(*SHARES) * left.width)
        ray = left.rays(rng.uniform((0, 0), (left.width, left.height))[None])[0]
        tilts = rng.uniform(-TILT_DEG, TILT_DEG, 2)
        turn = Rotation.from_euler("xyz", [*tilts, rng.uniform(-ROLL_DEG, ROLL_DEG)], degrees=True)
        pose = Pose("cam0", "board", turn.as_matrix(), depth * ray / ray[2])
        corners = pose.apply(sheet.corners_m)
        if _inside(left, corners) and _inside(rig.cam1, rig.cam0_from_cam1.inverse().apply(corners)):
            return pose
    size = " x ".join(f"{side:.2f} m" for side in sheet.size_m)
    raise ConfigError(f"a board of {size} doesn't fit into both pictures: take a larger or a smaller one")


def _inside(camera: Camera, points: Float64) -> bool:
    if (points[:, 2] <= 0).any():
        return False
    pixels = camera.project(points)
    most = np.array([camera.width, camera.height]) - 1 - MARGIN_PX
    return bool(((pixels >= MARGIN_PX) & (pixels <= most)).all())
