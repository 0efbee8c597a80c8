"""Rectification against the raw camera models: where the maps look is where a point is seen."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.geometry.remap import Warp
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.pairs import StereoFrame

RADTAN = (-0.28, 0.07, 0.0002, 1.8e-05)
EQUIDISTANT = (-0.013, 0.021, -0.011, 0.002)
BODY_FROM_CAM0 = Pose(
    "body", "cam0", Rotation.from_euler("xyz", [3.0, 0.1, -1.5]).as_matrix(), np.array([0.1, -0.2, 0.05])
)


def rig(
    model: Distortion = Distortion.RADTAN,
    coefficients: tuple[float, ...] = RADTAN,
    turn: tuple[float, float, float] = (0.02, -0.03, 0.015),
    place: tuple[float, float, float] = (0.3, 0.004, -0.006),
) -> StereoRig:
    """A rig whose cameras differ and are turned against each other."""
    cam0 = Camera(640, 480, 460, 458, 322, 236, model, coefficients)
    cam1 = Camera(640, 480, 455, 457, 315, 247, model, coefficients)
    cam0_from_cam1 = Pose("cam0", "cam1", Rotation.from_rotvec(turn).as_matrix(), np.array(place))
    return StereoRig(cam0, cam1, BODY_FROM_CAM0, BODY_FROM_CAM0 @ cam0_from_cam1)


RIGS = {
    "radtan": rig(),
    "radtan 8": rig(Distortion.RADTAN, (0.2, -0.05, 0.0005, -0.001, 0.01, 0.35, -0.03, 0.004)),
    "equidistant": rig(Distortion.EQUIDISTANT, EQUIDISTANT),
    "pinhole": rig(Distortion.NONE, ()),
}


def ramps(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Images whose gray level says the column or the row they were taken from."""
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    return (u * 255 / (width - 1)).astype(np.uint8), (v * 255 / (height - 1)).astype(np.uint8)


def raw_places(rectifier: Rectifier, side: str, pixels: np.ndarray) -> np.ndarray:
    """Find the places in the raw image that the rectifier takes for rectified pixels (N, 2)."""
    warp = rectifier._warps[side == "right"]
    place = pixels.astype(np.float32)[None]
    maps = [cv2.remap(m, place[..., 0], place[..., 1], cv2.INTER_LINEAR)[0] for m in (warp.map_x, warp.map_y)]
    return np.column_stack(maps)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("name", RIGS)
def test_points_land_where_the_maps_look(name: str, side: str) -> None:
    """Points in rect0 that the rectified camera's own formula puts on whole pixels: the maps, which hold
    float32, lead from there to where the raw camera sees them.
    """
    rig, rectifier = RIGS[name], Rectifier(RIGS[name])
    camera = rectifier.camera
    u, v = (a.ravel() for a in np.meshgrid(np.arange(0, 640, 7), np.arange(0, 480, 7)))
    z = np.random.default_rng(1).uniform(2, 20, u.size)
    shift = camera.focal_px * camera.baseline_m / z - camera.doffs_px if side == "right" else 0
    x, y = ((u + shift - camera.cx_px) * z / camera.focal_px, (v - camera.cy_px) * z / camera.focal_px)
    in_body = rectifier.body_from_rect0.apply(np.column_stack([x, y, z]))
    raw, body_from_cam = {
        "left": (rig.cam0, rig.body_from_cam0),
        "right": (rig.cam1, rig.body_from_cam1),
    }[side]
    expected = raw.project(body_from_cam.inverse().apply(in_body))
    warp = rectifier._warps[side == "right"]
    np.testing.assert_allclose(np.column_stack([warp.map_x[v, u], warp.map_y[v, u]]), expected, atol=2e-4)
    inside = ((expected >= 0) & (expected <= (639, 479))).all(axis=1)
    assert (warp.valid[v, u] == inside).mean() > 0.999


@pytest.mark.parametrize("name", RIGS)
def test_rows_agree_and_depth_comes_back(name: str) -> None:
    """The raw pixels of both cameras, undone by their own models and turned into the rectified axes."""
    rig, rectifier = RIGS[name], Rectifier(RIGS[name])
    camera = rectifier.camera
    rng = np.random.default_rng(2)
    points = rng.uniform((-1, -0.8, 3), (1, 0.8, 12), (500, 3))
    in_body = rectifier.body_from_rect0.apply(points)
    pixels = []
    for raw, body_from_cam, cx in (
        (rig.cam0, rig.body_from_cam0, camera.cx_px),
        (rig.cam1, rig.body_from_cam1, camera.cx_px + camera.doffs_px),
    ):
        rays = raw.rays(raw.project(body_from_cam.inverse().apply(in_body)))
        turned = rays @ (rectifier.body_from_rect0.rotation.T @ body_from_cam.rotation).T
        pixels.append(turned[:, :2] / turned[:, 2:] * camera.focal_px + (cx, camera.cy_px))
    left, right = pixels
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-3)
    disparity = left[:, 0] - right[:, 0]
    depth = camera.focal_px * camera.baseline_m / (disparity + camera.doffs_px)
    np.testing.assert_allclose(depth, points[:, 2], rtol=1e-6)


def test_images_and_masks_are_warped() -> None:
    rectifier = Rectifier(rig())
    columns, rows = ramps(640, 480)
    pair = rectifier(StereoFrame(7, columns, rows))
    assert pair.stamp_ns == 7
    for image, side, axis in ((pair.left, "left", 0), (pair.right, "right", 1)):
        valid = getattr(pair, f"{side}_valid")
        assert valid.mean() > 0.8
        u, v = 311, 205
        place = raw_places(rectifier, side, np.array([[u, v]]))[0]
        assert abs(image[v, u] - place[axis] * 255 / (639, 479)[axis]) < 1.2
    assert rectifier.body_from_rect0.target == "body"
    np.testing.assert_allclose(rectifier.body_from_rect0.translation, BODY_FROM_CAM0.translation)


@pytest.mark.parametrize("turn", [(0.02, -0.03, 0.015), (0.05, 0.1, 0.6)])
def test_pixels_are_read_between_the_raw_ones(turn: tuple[float, float, float]) -> None:
    """Waves of 9 px and more, at the very places that the maps name; OpenCV rounds them to 1/32 px."""

    def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 128 + 50 * np.sin(0.7 * x + 0.2 * y) + 50 * np.cos(0.1 * x - 0.6 * y)

    v, u = np.mgrid[:480, :640].astype(np.float64)
    raw = np.rint(waves(u, v)).astype(np.uint8)
    warp = Rectifier(rig(turn=turn))._warps[1]
    inner = (warp.map_x > 2) & (warp.map_x < 636) & (warp.map_y > 2) & (warp.map_y < 476)
    assert inner.mean() > 0.5
    true = waves(warp.map_x.astype(np.float64), warp.map_y.astype(np.float64))
    theirs = cv2.remap(raw, warp.map_x, warp.map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    rms, rms_theirs = (np.sqrt(np.mean((picture - true)[inner] ** 2)) for picture in (warp(raw), theirs))
    assert rms < 1.4
    assert rms < 1.05 * rms_theirs
    beyond = ~warp.valid
    np.testing.assert_allclose(warp(np.full_like(raw, 90))[beyond], 90)


def cubic(line: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Keys's convolution with -0.75 at places along a line whose ends are repeated."""
    whole, value = np.floor(places).astype(int), np.zeros(len(places))
    for k in range(-1, 3):
        t = np.abs(places - whole - k)
        near = 1.25 * t**3 - 2.25 * t**2 + 1
        far = -0.75 * (t**3 - 5 * t**2 + 8 * t - 4)
        value += np.where(t <= 1, near, far) * line[(whole + k).clip(0, len(line) - 1)]
    return value


def test_a_warp_reads_columns_then_rows() -> None:
    """Places inside, on the border and beyond; rounded to levels."""
    rng = np.random.default_rng(7)
    image = rng.integers(0, 256, (24, 31), np.uint8)
    map_x = np.sort(rng.uniform(-4, 34, (9, 20)), axis=1).astype(np.float32)
    crossing = (rng.uniform(-3, 26, (9, 1)) + np.linspace(-2, 2, 31)).astype(np.float32)
    warped = Warp(map_x, map_x, np.ones(map_x.shape, bool), crossing)(image)
    for row, places, found in zip(crossing.astype(float), map_x.astype(float), warped, strict=True):
        read = np.array([cubic(image[:, c].astype(float), row[c : c + 1])[0] for c in range(31)])
        wanted = cubic(read, places.clip(-1, 31)).clip(0, 255)
        np.testing.assert_allclose(found, wanted, atol=0.501)


def test_a_rectified_pair_passes_untouched() -> None:
    cam0 = Camera(64, 48, 70, 70, 30, 22)
    cam1 = Camera(64, 48, 70, 70, 33, 22)
    place = Pose("cam0", "cam1", np.eye(3), np.array([0.5, 0, 0]))
    rectifier = Rectifier(StereoRig(cam0, cam1, BODY_FROM_CAM0, BODY_FROM_CAM0 @ place))
    camera = rectifier.camera
    assert (camera.focal_px, camera.cx_px, camera.cy_px, camera.doffs_px) == (70, 30, 22, 3)
    assert camera.baseline_m == pytest.approx(0.5, abs=1e-12)
    np.testing.assert_allclose(rectifier.body_from_rect0.matrix, BODY_FROM_CAM0.matrix, atol=1e-15)
    rng = np.random.default_rng(0)
    left, right = rng.integers(0, 256, (2, 48, 64), dtype=np.uint8)
    pair = rectifier(StereoFrame(1, left, right))
    np.testing.assert_array_equal(pair.left, left)
    np.testing.assert_array_equal(pair.right, right)
    assert pair.left_valid.all()
    assert pair.right_valid.all()


def test_an_equidistant_lens_of_zeros_is_rectified() -> None:
    """It looks like a rectified pair but isn't one."""
    lens = Camera(64, 48, 70, 70, 31.5, 23.5, Distortion.EQUIDISTANT, (0.0,) * 4)
    place = Pose("cam0", "cam1", np.eye(3), np.array([0.5, 0, 0]))
    rectifier = Rectifier(StereoRig(lens, lens, BODY_FROM_CAM0, BODY_FROM_CAM0 @ place))
    np.testing.assert_allclose(
        raw_places(rectifier, "left", np.array([[63, 23.5]]))[0],
        [31.5 + 70 * np.arctan(31.5 / 70), 23.5],
        atol=0.03,
    )


def test_an_image_of_another_size_is_refused() -> None:
    good, small = np.zeros((480, 640), np.uint8), np.zeros((48, 64), np.uint8)
    rectifier = Rectifier(rig())
    refused = rectifier(StereoFrame(1, good, small))
    assert refused == Failed("wrong-size", "the right image is 64x48, the calibration is for 640x480")


@pytest.mark.parametrize(
    ("turn", "place", "message"),
    [
        ((0, 0, 0), (-0.3, 0.01, 0), "left and right are swapped"),
        ((0, 0, 0), (0, 0, 0), "the baseline is zero"),
        ((0, 0, 0), (0.01, 0.3, 0), "does not run along cam0's rows"),
        ((0, 0, 0), (0.01, 0, 0.3), "does not run along cam0's rows"),
        ((0, 1.2, 0), (0.3, 0, 0), "60 degrees apart"),
    ],
)
def test_a_rig_that_cant_be_is_refused(
    turn: tuple[float, float, float], place: tuple[float, float, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        rig(turn=turn, place=place)
