"""Rays, grid and light against slow, obvious references."""

from __future__ import annotations

import numpy as np
import pytest

from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.simulation.lighting import Lamps, Lightmap, bake, hall_lamps
from barsight.simulation.optics import sample_rays
from barsight.simulation.rays import cast_rays
from barsight.simulation.render import Shading, render_view, shade
from barsight.simulation.scene import Primitives, Scene, build_grid, build_scene
from barsight.simulation.settings import SimulationSettings, YardSettings
from barsight.simulation.stock import stack_yard
from barsight.simulation.textures import surface_tile


@pytest.fixture(scope="module")
def scene() -> Scene:
    settings = SimulationSettings(
        length_m=1.6, bars="60mm:7", yard=YardSettings(max_layers=2, bar_length_m=2)
    )
    stock = stack_yard(settings, np.random.default_rng(4))
    return build_scene(stock, settings, np.random.default_rng(5))


def slow_cylinder(s: Float64, origin: Float64, ray: Float64) -> float:
    """Candidates on the mantle (roots of a polynomial) and both caps; the nearest one that is on the bar."""
    centre, axis, radius, half = s[0:3], s[3:6], s[12], s[13]
    o, d = origin - centre, ray
    across_o, across_d = o - (o @ axis) * axis, d - (d @ axis) * axis
    mantle = np.roots([across_d @ across_d, 2 * across_o @ across_d, across_o @ across_o - radius**2])
    hits = [t.real for t in mantle if abs(t.imag) < 1e-12 and abs((o + t.real * d) @ axis) <= half]
    for end in (-half, half):
        t = (end - o @ axis) / (d @ axis)
        if np.linalg.norm(across_o + t * across_d) <= radius:
            hits.append(t)
    return min((t for t in hits if t > 0), default=np.inf)


def slow_box(s: Float64, origin: Float64, ray: Float64) -> float:
    """The six faces' planes; the nearest crossing that lies on its face."""
    axes, half = s[3:12].reshape(3, 3), s[12:15]
    o, d = axes @ (origin - s[0:3]), axes @ ray
    hits = []
    for k in range(3):
        for side in (-half[k], half[k]):
            t = (side - o[k]) / d[k]
            place = np.abs(o + t * d)
            place[k] = 0
            if (place <= half).all() and t > 0:
                hits.append(t)
    return min(hits, default=np.inf)


def slow_trace(scene: Scene, origin: Float64, ray: Float64) -> tuple[float, int]:
    """Every primitive, one after the other, and the floor."""
    shape, _, cylinders = scene.primitives
    hits = [
        slow_cylinder(s, origin, ray) if p < cylinders else slow_box(s, origin, ray)
        for p, s in enumerate(shape)
    ]
    hits.append(-origin[2] / ray[2] if ray[2] < 0 else np.inf)
    nearest = int(np.argmin(hits))
    return hits[nearest], nearest if np.isfinite(hits[nearest]) else -1


def test_grid_walk_finds_what_trying_every_primitive_finds(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    n = 250
    targets = np.column_stack([rng.uniform(-0.5, 2.1, n), rng.uniform(-1.3, 1.3, n), rng.uniform(0, 0.9, n)])
    outward = rng.normal(0, 1, (n, 3))
    outward[:, 2] = np.abs(outward[:, 2])
    origins = (0.8, 0.0, 0.05) + 4.0 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    rays = targets - origins
    distance, primitive = cast_rays(scene, origins, rays)
    slow = [slow_trace(scene, o, d) for o, d in zip(origins, rays, strict=True)]
    slow_distance = np.array([t for t, _ in slow])
    met = np.isfinite(slow_distance)
    np.testing.assert_array_equal(np.isfinite(distance), met)
    np.testing.assert_allclose(distance[met], slow_distance[met], rtol=0, atol=1e-9)
    agree = primitive[met] == np.array([p for _, p in slow])[met]
    assert agree.mean() > 0.99
    assert 0.2 < (primitive[met] < scene.primitives.cylinders).mean() < 0.95


def test_rays_along_the_axes_of_the_grid_are_no_trap(scene: Scene) -> None:
    x = np.linspace(0, 1.6, 40)
    origins = np.column_stack([x, np.zeros(40), np.full(40, 5.0)])
    down = np.tile([0.0, 0.0, -1.0], (40, 1))
    distance, primitive = cast_rays(scene, origins, down)
    tilted, _ = cast_rays(scene, origins, np.tile([1e-9, 1e-9, -1.0], (40, 1)))
    np.testing.assert_allclose(distance, tilted, atol=1e-6)
    assert (primitive >= 0).all()
    level, found = cast_rays(scene, np.array([[0.8, 0.0, 50.0]]), np.array([[1.0, 0.0, 0.0]]))
    assert found[0] == -1
    assert np.isinf(level[0])


def test_sample_rays_invert_the_lens() -> None:
    camera = Camera(320, 256, 312.0, 312.0, 161.2, 126.1, Distortion.RADTAN, (-0.06, 0.02, 0.0003, -0.0002))
    for side in (1, 2, 3):
        rays = sample_rays(camera, side).astype(np.float64)
        v, u = np.meshgrid(np.arange(side * 256), np.arange(side * 320), indexing="ij")
        wanted = np.column_stack([(u.ravel() + 0.5) / side - 0.5, (v.ravel() + 0.5) / side - 0.5])
        points = np.column_stack([rays.reshape(-1, 2), np.ones(u.size)])
        assert np.abs(camera.project(points) - wanted).max() < 1e-4


def open_light(lamps: Lamps, x: float, y: float) -> float:
    """Irradiance of a level surface at (x, y, 0) under an open hall."""
    total = lamps.ambient
    for lamp in range(-10, 11):
        for row in lamps.rows:
            dx, dy, dz = lamp * lamps.spacing + lamps.offset - x, row - y, lamps.z
            r = np.sqrt(dx**2 + dy**2 + dz**2)
            u = dx / (1.5 * lamps.spacing)
            beam = lamps.power * max(0.0, 1 - u**2) ** 2 if abs(u) < 1 else 0.0
            total += beam * (dz / r) ** 2 / r**2
    return total


@pytest.fixture(scope="module")
def lightmap(scene: Scene) -> Lightmap:
    return bake(scene, hall_lamps(8.0), np.random.default_rng(0))


def test_open_floor_gets_the_light_of_the_formula(scene: Scene, lightmap: Lightmap) -> None:
    floor = len(scene.primitives.shape)
    light = lightmap.diffuse[lightmap.start[floor] :].reshape(lightmap.along[floor], lightmap.around[floor])
    low_x, low_y, step = lightmap.floor
    i, j = 6, light.shape[1] // 2
    place = (low_x + (i + 0.5) * step, low_y + (j + 0.5) * step)
    assert light[i, j] == pytest.approx(open_light(hall_lamps(8.0), *place), rel=0.02)
    under = int((0.8 - low_x) / step), int((0.0 - low_y) / step)
    assert light[under] < 0.35 * light[i, j]


def test_render_is_the_mean_of_its_shaded_samples(scene: Scene, lightmap: Lightmap) -> None:
    look = Shading(hall_lamps(8.0), lightmap, surface_tile(np.random.default_rng(1), 0.0064))
    camera = Camera(96, 80, 120.0, 120.0, 47.5, 39.5)
    rotation = np.diag([1.0, -1.0, -1.0])
    pose = Pose("yard", "cam", rotation, np.array([0.8, 0.1, 3.0]))
    rays = sample_rays(camera, 2)
    image = render_view(scene, look, rays, 2, pose)
    rng = np.random.default_rng(2)
    for _ in range(25):
        v, u = int(rng.integers(80)), int(rng.integers(96))
        values, ids = {}, {}
        for row in (0, 1):
            for column in (0, 1):
                ray = rotation @ [*rays[2 * v + row, 2 * u + column].astype(np.float64), 1.0]
                t, p = slow_trace(scene, pose.translation, ray)
                ids[row, column] = p
                values[row, column] = shade(scene.primitives, look, p, *pose.translation, *(t * ray))
        diagonal = [(0, 0), (1, 1)]
        used = diagonal if ids[0, 0] == ids[1, 1] else list(values)
        assert image[v, u] == pytest.approx(np.mean([values[k] for k in used]), rel=1e-5, abs=1e-6)


def test_a_grid_of_nothing_sees_the_floor() -> None:
    primitives = Primitives(np.empty((0, 15)), np.empty((0, 8), dtype=np.float32), 0)
    empty = Scene(primitives, build_grid(primitives, (0.1, 0.5)))
    distance, found = cast_rays(empty, np.array([[0.0, 0.0, 2.0]]), np.array([[0.1, 0.0, -1.0]]))
    assert distance[0] == pytest.approx(2.0)
    assert found[0] == 0
