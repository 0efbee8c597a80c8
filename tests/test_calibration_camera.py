"""Camera models: projecting and looking back agree, and match the textbook's formulas."""

import numpy as np
import pytest

from barsight.calibration.geometry.camera import Camera, Distortion

CAMERAS = {
    "none": (Distortion.NONE, ()),
    "radtan 4": (Distortion.RADTAN, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)),
    "radtan 5": (Distortion.RADTAN, (-0.25, 0.09, 0.001, -0.0008, -0.012)),
    "radtan 8": (Distortion.RADTAN, (0.2, -0.05, 0.0005, -0.001, 0.01, 0.35, -0.03, 0.004)),
    "radtan of zeros": (Distortion.RADTAN, (0.0,) * 4),
    "equidistant": (Distortion.EQUIDISTANT, (-0.013, 0.021, -0.011, 0.002)),
    "equidistant of zeros": (Distortion.EQUIDISTANT, (0.0,) * 4),
}


@pytest.fixture(params=CAMERAS, ids=lambda name: name)
def camera(request: pytest.FixtureRequest) -> Camera:
    distortion, coefficients = CAMERAS[request.param]
    return Camera(752, 480, 458.654, 457.296, 367.215, 248.375, distortion, coefficients)


def grid() -> np.ndarray:
    """Pixels over the whole image, its corners included."""
    u, v = np.meshgrid(np.linspace(0, 751, 31), np.linspace(0, 479, 21))
    return np.column_stack([u.ravel(), v.ravel()])


def projected(camera: Camera, points: np.ndarray) -> np.ndarray:
    """The models as their authors write them."""
    x, y = (points[:, :2] / points[:, 2:]).T
    r2 = x * x + y * y
    k = np.zeros(8)
    k[: len(camera.coefficients)] = camera.coefficients
    if camera.distortion is Distortion.EQUIDISTANT:
        r = np.sqrt(r2)
        theta = np.arctan(r)
        bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
        x, y = x * scale, y * scale
    else:
        radial = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
        x, y = (
            x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y,
        )
    return np.column_stack([camera.fx_px * x + camera.cx_px, camera.fy_px * y + camera.cy_px])


def test_rays_and_project_are_inverse(camera: Camera) -> None:
    rays = camera.rays(grid())
    np.testing.assert_array_equal(rays[:, 2], 1)
    np.testing.assert_allclose(camera.project(rays), grid(), atol=1e-6)
    np.testing.assert_allclose(camera.project(7.5 * rays), grid(), atol=1e-6)


def test_project_is_the_textbooks(camera: Camera) -> None:
    points = camera.rays(grid()) * np.linspace(0.5, 30, len(grid()))[:, None]
    np.testing.assert_allclose(camera.project(points), projected(camera, points), atol=1e-9)


def test_only_a_pinhole_is_ideal() -> None:
    """An equidistant lens bends rays even where its coefficients are zero."""
    ideal = {name for name, model in CAMERAS.items() if Camera(64, 48, 60, 60, 31, 23, *model).is_ideal}
    assert ideal == {"none", "radtan of zeros"}


def test_the_matrix_projects() -> None:
    camera = Camera(640, 480, 500, 510, 320, 240)
    np.testing.assert_array_equal(camera.matrix @ [0.1, -0.2, 1], [370, 138, 1])
    assert camera.project(np.empty((0, 3))).shape == (0, 2)
    assert camera.rays(np.empty((0, 2))).shape == (0, 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx_px": 0.0}, "must be positive"),
        ({"fy_px": -500.0}, "must be positive"),
        ({"cx_px": float("nan")}, "not finite"),
        ({"cx_px": 5000.0}, "far outside"),
        ({"width": 0}, "is impossible"),
        (
            {"distortion": Distortion.RADTAN, "coefficients": (0.1,) * 3},
            "takes 4 or 5 or 8 coefficients, not 3",
        ),
        ({"distortion": Distortion.EQUIDISTANT, "coefficients": (0.1,) * 5}, "takes 4 coefficients, not 5"),
        ({"coefficients": (0.1,) * 4}, "none takes 0 coefficients"),
        ({"distortion": Distortion.RADTAN, "coefficients": (0.1, 0, 0, float("inf"))}, "not finite"),
    ],
)
def test_what_cant_be_is_refused(changes: dict[str, object], message: str) -> None:
    good = {"width": 640, "height": 480, "fx_px": 500.0, "fy_px": 500.0, "cx_px": 320.0, "cy_px": 240.0}
    with pytest.raises(ValueError, match=message):
        Camera(**{**good, **changes})
