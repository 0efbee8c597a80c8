"""Hold the renderer's pictures against path-traced ones of the same bundles: stereo errors and contrast.

    python benchmarks/appearance.py yard_dev yard_thin [--texture-ratio 0.5 --gloss 0.5 ...]

Each argument is a path-traced recording with truth whose bundles are hexagonal (`bundles.json` with `lay`).
Its bundles are drawn anew as `simulate` draws them, seen by the same rig from the same pose: what differs is
light and surface. For each view with true depth: errors of the default stereo against true disparity (px), on
the stack (over 0.2 m) and on the floor; gray levels; contrast along and across the bars at 1 to 8 px.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from barsight.calibration.files.euroc import read_rig
from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Bool, Float32, Float64, UInt8
from barsight.core.pose import Pose
from barsight.core.records.pairs import StereoFrame
from barsight.reconstruction.pair_matching import disparity_range
from barsight.recording.formats.ground_truth import read_ground_truth
from barsight.simulation.effects.settings import LightSettings
from barsight.simulation.lighting import bake, hall_lamps
from barsight.simulation.optics import expose, sample_rays, vignette
from barsight.simulation.render import Shading, render_view
from barsight.simulation.scene import Scene, build_scene
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.yard import BarKind, YardSettings
from barsight.simulation.stock import DunnageBeam, StackedBundle, Stock, hexagonal_packing
from barsight.simulation.textures import surface_tile
from barsight.simulation.truth import true_depth
from barsight.stereo.settings import StereoSettings, make_method

STACK_M = 0.2
SCALES_PX = (1, 2, 4, 8)


def main() -> None:
    """Print a table of both pictures of each view."""
    parser = argparse.ArgumentParser()
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--texture-ratio", type=float, default=1.0)
    parser.add_argument("--gloss", type=float, default=1.0)
    for name in ("ambient", "bounce-ratio", "lamp-ratio"):
        parser.add_argument(f"--{name}", type=float, default=getattr(LightSettings(), name.replace("-", "_")))
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    light = LightSettings(ambient=given.ambient, bounce_ratio=given.bounce_ratio, lamp_ratio=given.lamp_ratio)
    for recording in given.recordings:
        for depth_file in sorted((recording / "truth").glob("depth_cam0_*.npz")):
            stamp = int(depth_file.stem.rpartition("_")[2])
            rig, yard_from_body = read_rig(recording / "mav0"), _pose(recording, stamp)
            traced = [_read(recording / "mav0" / name / "data" / f"{stamp}.png") for name in ("cam0", "cam1")]
            depth = np.load(depth_file)["z"]
            _tell(f"{recording.name} traced", rig, yard_from_body, traced, depth)
            scene, settings = _same_bundles(recording, given.texture_ratio, given.gloss)
            drawn, depth = _drawn(scene, settings, light, rig, yard_from_body)
            _tell(f"{recording.name} drawn ", rig, yard_from_body, drawn, depth)
            if given.pictures:
                both = np.hstack([traced[0], drawn[0]])
                cv2.imwrite(str(given.pictures / f"{recording.name}_{stamp}.png"), both)


def _read(path: Path) -> UInt8:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)


def _pose(recording: Path, stamp_ns: int) -> Pose:
    truth = read_ground_truth(recording, reference="yard")
    offset = json.loads((recording / "truth" / "rig.json").read_text())["time_offset_s"]
    t = (truth.stamp_ns - stamp_ns) / 1e9 - offset
    near = slice(max(int(np.searchsorted(t, 0)) - 3, 0), int(np.searchsorted(t, 0)) + 3)
    places = np.array([p.translation for p in truth.poses[near]])
    turns = Rotation.from_matrix(np.array([p.rotation for p in truth.poses[near]]))
    place = np.array([np.interp(0.0, t[near], places[:, k]) for k in range(3)])
    return Pose("yard", "body", Slerp(t[near], turns)([0.0]).as_matrix()[0], place)


def _same_bundles(recording: Path, texture_ratio: float, gloss: float) -> tuple[Scene, SimulationSettings]:
    """Stack the recording's bundles, with beams under each layer; the rolls are right but for their sign."""
    rng = np.random.default_rng(0)
    rows = json.loads((recording / "truth" / "bundles.json").read_text())
    bundles, beams = [], []
    for row in rows:
        kind = BarKind(row["bar_diameter"], row["bars"])
        rolls = np.linspace(0, np.pi / 6, 301)
        packing = hexagonal_packing(kind)
        tops = [(packing @ _turn(r))[:, 1].max() + kind.diameter_m / 2 for r in rolls]
        roll = float(rolls[np.argmin(np.abs(np.array(tops) - row["top_z"] + row["center"][2]))])
        cross = packing @ _turn(roll * float(rng.choice([-1, 1])))
        yaw, centre = float(np.radians(row["yaw_deg"])), np.array(row["center"])
        place = row["sec"], row["lay"], row["col"]
        bundles.append(StackedBundle(*place, kind, centre, yaw, roll, cross, row["length"], ribbed=False))
    for section, layer in sorted({(b.section, b.layer) for b in bundles}):
        on = [b for b in bundles if (b.section, b.layer) == (section, layer)]
        x = [float(b.centre_m[0]) for b in on]
        base = min(float(b.centre_m[2] + b.cross_m[:, 1].min()) - b.kind.diameter_m / 2 for b in on)
        for share in (-0.36, 0.0, 0.36):
            centre = np.array([(min(x) + max(x)) / 2, share * on[0].length_m, base - 0.045])
            half = np.array([(max(x) - min(x)) / 2 + 0.3, 0.045, 0.045])
            beams.append(DunnageBeam(centre, half, 0.0))
    settings = SimulationSettings(yard=YardSettings(gloss=gloss, texture_ratio=texture_ratio))
    return build_scene(Stock(tuple(bundles), tuple(beams)), settings, rng), settings


def _turn(angle: float) -> Float64:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s], [-s, c]])


def _drawn(
    scene: Scene, settings: SimulationSettings, light: LightSettings, rig: StereoRig, yard_from_body: Pose
) -> tuple[list[UInt8], Float32]:
    """Render both cameras, and the true depth of the left one."""
    camera = CameraSettings()
    lamps = hall_lamps(camera.above_floor_m, light)
    rng = np.random.default_rng(1)
    tile = surface_tile(rng, camera.above_floor_m / camera.focal_px, settings.yard.texture_ratio)
    look = Shading(lamps, bake(scene, lamps, rng), tile)
    pictures = []
    for lens, mount, gain in ((rig.cam0, rig.body_from_cam0, 1.0), (rig.cam1, rig.body_from_cam1, 0.95)):
        radiance = render_view(scene, look, sample_rays(lens, 2), 2, yard_from_body @ mount)
        pictures.append(expose(radiance, vignette(lens, camera.vignetting), gain, camera, rng))
    return pictures, true_depth(scene, rig.cam0, yard_from_body @ rig.body_from_cam0)


def _tell(name: str, rig: StereoRig, yard_from_body: Pose, pictures: list[UInt8], depth: Float32) -> None:
    rectifier = Rectifier(rig)
    pair = rectifier(StereoFrame(0, *pictures))
    truth, height = _true_disparity(rig, rectifier, yard_from_body, depth)
    settings = replace(StereoSettings(), min_disparity_px=50, max_disparity_px=110)
    found = make_method(settings)(pair, disparity_range(pair, settings))
    error, sigma = found.disparity_px - truth, found.sigma_px
    filled = np.nan_to_num(truth, nan=1e3)
    steady = cv2.dilate(filled, np.ones((3, 3))) - cv2.erode(filled, np.ones((3, 3))) < 0.5
    print(f"{name}: rectified {pair.left.shape}")
    for place, mask in (("stack", height > STACK_M), ("floor", np.abs(height) < 0.02)):
        asked = mask & steady & np.isfinite(truth)
        known = asked & np.isfinite(error)
        e, gray = error[known], pair.left[asked]
        size = np.abs(e)
        print(
            f"  {place}: {known.sum() / asked.sum():6.1%} matched, median |e| {np.median(size):.3f} px, bias "
            f"{np.median(e):+.3f}, P95 {np.percentile(size, 95):.3f}, over 1 px {np.mean(size > 1):.2%}, "
            f"in 95 % {np.mean(size <= 1.96 * sigma[known]):.1%}; gray {gray.mean():.0f}, P5 "
            f"{np.percentile(gray, 5):.0f}, P95 {np.percentile(gray, 95):.0f}; contrast % at {SCALES_PX} px "
            f"along {_contrast(pair.left, asked, 0)} across {_contrast(pair.left, asked, 1)}"
        )


def _contrast(image: UInt8, mask: Bool, axis: int) -> list[float]:
    """Measure the spread of the differences between Gaussian means of widths s and 2 s along an axis, as a
    percentage of the local gray level: median of the size over the mask.
    """
    gray = image.astype(np.float32)
    mean = cv2.GaussianBlur(gray, (0, 0), 20)
    out = []
    for scale in SCALES_PX:
        parts = []
        for width in (scale, 2 * scale):
            sigmas = (0.01, width) if axis == 0 else (width, 0.01)
            parts.append(cv2.GaussianBlur(gray, (0, 0), sigmaX=sigmas[0], sigmaY=sigmas[1]))
        out.append(round(100 * float(np.median((np.abs(parts[0] - parts[1]) / mean)[mask])), 2))
    return out


def _true_disparity(
    rig: StereoRig, rectifier: Rectifier, yard_from_body: Pose, depth: Float32
) -> tuple[Float32, Float32]:
    """Compute the rectified left picture's true disparity (px), and the height over the floor (m)."""
    camera = rectifier.camera
    v, u = np.meshgrid(np.arange(camera.height), np.arange(camera.width), indexing="ij")
    rays = np.stack(
        [(u - camera.cx_px) / camera.focal_px, (v - camera.cy_px) / camera.focal_px, np.ones(u.shape)]
    )
    cam0_from_rect = (rig.body_from_cam0.inverse() @ rectifier.body_from_rect0).rotation
    raw = cam0_from_rect @ rays.reshape(3, -1)
    lens: Camera = rig.cam0
    pixels = lens.project((raw / raw[2]).T).astype(np.float32).reshape(*u.shape, 2)
    along = cv2.remap(depth, pixels[..., 0], pixels[..., 1], cv2.INTER_NEAREST, borderValue=np.nan)
    z = along / raw[2].reshape(u.shape)
    points = (yard_from_body @ rectifier.body_from_rect0).apply((rays * z).reshape(3, -1).T)
    truth = camera.focal_px * camera.baseline_m / z - camera.doffs_px
    return truth.astype(np.float32), points[:, 2].reshape(u.shape).astype(np.float32)


if __name__ == "__main__":
    main()
