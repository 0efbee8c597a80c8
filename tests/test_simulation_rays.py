"""Rays, grid and light against slow, obvious references."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.simulation.lighting import (
    AROUND,
    Lamps,
    Lightmap,
    _ceiling_directions,
    bake,
    hall_lamps,
    lamp_beam,
    longest_axis,
)
from barsight.simulation.optics import sample_rays
from barsight.simulation.rays import FAR, cast_rays, hit_box, hit_cylinder, trace
from barsight.simulation.render import (
    FLOOR_ALBEDO,
    HIGHLIGHT,
    SPREAD_ALONG,
    SPREAD_AROUND,
    Shading,
    _lightmap_place,
    _texels,
    render_view,
    shade,
)
from barsight.simulation.scene import Primitives, Scene, build_grid, build_scene
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.stock import stack_yard
from barsight.simulation.textures import TILE, surface_tile


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


@pytest.mark.slow
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


def texel_slowly(scene: Scene, lightmap: Lightmap, p: int, s: int, a: int) -> tuple[Float64, Float64]:
    """A texel's middle 1 mm off the bar or box, and the normal."""
    own, axes = scene.primitives.shape[p], scene.primitives.shape[p, 3:12].reshape(3, 3)
    share = (s + 0.5) / lightmap.along[p] * 2 - 1
    if p < scene.primitives.cylinders:
        angle = 2 * np.pi * (a + 0.5) / AROUND
        normal = np.cos(angle) * axes[1] + np.sin(angle) * axes[2]
        return own[:3] + share * own[13] * axes[0] + (own[12] + 1e-3) * normal, normal
    half, face, side = own[12:15], a // 2, 2 * (a % 2) - 1
    longest = int(half.argmax())
    along = share * half[longest] * axes[longest] * (longest != face)
    return own[:3] + along + side * (half[face] + 1e-3) * axes[face], side * axes[face]


def light_slowly(
    scene: Scene, lamps: Lamps, place: Float64, normal: Float64
) -> tuple[float, dict[int, float]]:
    """Irradiance, and the share of each lamp by slot, by shadow rays one by one."""

    def is_open(rays: Float64, reach: float) -> np.ndarray:
        return ~(cast_rays(scene, place[None], rays)[0] < reach)

    sky = _ceiling_directions()
    cosine = np.maximum(sky @ normal, 0)
    total = lamps.ambient * (0.05 + 0.95 * (cosine * is_open(sky, np.inf)).sum() / sky[:, 2].sum())
    shares = {}
    for lamp in range(-5, 6):
        for row, y in enumerate(lamps.rows):
            way = np.array([lamp * lamps.spacing + lamps.offset, y, lamps.z]) - place
            if abs(way[0]) >= 1.5 * lamps.spacing:
                continue
            off = np.array([[0.0, end * 0.6 * lamps.half_length, 0.0] for end in (-1, 1)])
            r = np.linalg.norm(way)
            share = is_open(way + off, 1.0).mean() if way @ normal / r > -0.2 else 0.0
            shares[lamp % 3 + 3 * row] = share
            power = lamps.power * (1 - (way[0] / (1.5 * lamps.spacing)) ** 2) ** 2
            total += share * max(way @ normal / r, 0) * power * way[2] / r**3
    return total, shares


def test_bars_and_boxes_get_the_light_that_no_primitive_holds_back(scene: Scene, lightmap: Lightmap) -> None:
    rng, lamps, cylinders = np.random.default_rng(3), hall_lamps(8.0), scene.primitives.cylinders
    lit = []
    for k in range(60):
        low, high = (0, cylinders) if k % 2 else (cylinders, len(scene.primitives.shape))
        p = int(rng.integers(low, high))
        s, a = int(rng.integers(lightmap.along[p])), int(rng.integers(lightmap.around[p]))
        place, normal = texel_slowly(scene, lightmap, p, s, a)
        t = lightmap.start[p] + s * lightmap.around[p] + a
        light, shares = light_slowly(scene, lamps, place, normal) if place[2] > 0 else (0.0, {})
        assert lightmap.diffuse[t] == pytest.approx(light, rel=1e-5)
        wanted = [int(255 * shares.get(slot, 0)) for slot in range(6)]
        np.testing.assert_array_equal(lightmap.seen[t], wanted)
        lit.append(max(wanted))
    assert 0.2 < np.mean(np.array(lit) > 0) < 0.9


def test_textures_and_lightmaps_are_read_between_their_texels(scene: Scene, lightmap: Lightmap) -> None:
    rng = np.random.default_rng(4)
    tile = rng.normal(size=(TILE, TILE, 4)).astype(np.float32)
    places = rng.uniform(-2 * TILE, 2 * TILE, (40, 2))
    for channel in range(4):
        wanted = map_coordinates(tile[..., channel].astype(float), places.T, order=1, mode="grid-wrap")
        np.testing.assert_allclose([_texels(tile, a, b)[channel] for a, b in places], wanted, atol=1e-6)
    p = int(lightmap.along[: scene.primitives.cylinders].argmax())
    n, values = lightmap.along[p], rng.normal(size=lightmap.diffuse.size)
    own = values[lightmap.start[p] :][: n * AROUND].reshape(n, AROUND)
    for share, angle in zip(rng.uniform(0, 1, 40), rng.uniform(-7, 7, 40), strict=True):
        t00, t01, t10, t11, ws, wa = _lightmap_place(lightmap, p, share, angle)
        found = (values[t00] * (1 - wa) + values[t01] * wa) * (1 - ws)
        found += (values[t10] * (1 - wa) + values[t11] * wa) * ws
        at = [[np.clip(share * n - 0.5, 0, n - 1)], [angle / (2 * np.pi) * AROUND - 0.5]]
        wanted = map_coordinates(own, at, order=1, mode="grid-wrap")[0]
        assert found == pytest.approx(wanted, abs=1e-9)


def test_surfaces_shine_as_their_material_and_light_say(scene: Scene, lightmap: Lightmap) -> None:
    """Under even light and a plain texture: bars, their ends, boxes and the floor, and a bar's highlight."""
    rng, lamps = np.random.default_rng(5), hall_lamps(8.0)
    tile = np.broadcast_to(np.array([1, 1, 0, 1], np.float32), (TILE, TILE, 4)).copy()
    even = lightmap._replace(
        diffuse=np.full_like(lightmap.diffuse, 0.5), seen=np.full_like(lightmap.seen, 255)
    )
    look, primitives = Shading(lamps, even, tile), scene.primitives
    plain = primitives.material.copy()
    plain[:, 1], plain[:, 6] = 0, 0
    matt, glossy = primitives._replace(material=plain), primitives._replace(material=plain.copy())
    glossy.material[:, 1] = 0.8
    eye, floor, box = np.array([0.7, 0.2, 6.0]), len(plain), primitives.cylinders
    assert shade(matt, look, floor, *eye, 0.1, -0.2, -6.0) == pytest.approx(FLOOR_ALBEDO * 0.5)
    way = primitives.shape[box, :3] - eye
    assert shade(matt, look, box, *eye, *way) == pytest.approx(plain[box, 0] * 0.5)
    for p in rng.integers(0, primitives.cylinders, 20):
        centre, axes, (radius, half) = (
            primitives.shape[p, :3], primitives.shape[p, 3:12].reshape(3, 3), primitives.shape[p, 12:14]
        )  # fmt: skip
        assert shade(matt, look, p, *eye, *(centre + half * axes[0] - eye)) == pytest.approx(
            plain[p, 0] * 0.35
        )
        angle, s = rng.uniform(0, np.pi), rng.uniform(-half, half)
        normal = math.cos(angle) * axes[1] + math.sin(angle) * axes[2]
        turned = math.cos(angle) * axes[2] - math.sin(angle) * axes[1]
        point = centre + s * axes[0] + radius * normal
        body = shade(matt, look, p, *eye, *(point - eye))
        assert body == pytest.approx(plain[p, 0] * 0.5, rel=1e-6)
        shine, away = 0.0, (eye - point) / np.linalg.norm(eye - point)
        for lamp in range(-5, 6):
            for y in lamps.rows:
                light = np.array([lamp * lamps.spacing + lamps.offset, y, lamps.z]) - point
                r, u = np.linalg.norm(light), light[0] / (1.5 * lamps.spacing)
                h = light / r + away
                if abs(u) >= 1 or h @ normal <= 0.1:
                    continue
                ward = (h @ axes[0] / SPREAD_ALONG) ** 2 + (h @ turned / SPREAD_AROUND) ** 2
                ward /= (h @ normal) ** 2
                shine += (ward <= 9) * math.exp(-ward) * lamps.power * (1 - u * u) ** 2 * light[2] / r**3
        found = shade(glossy, look, p, *eye, *(point - eye)) - body
        assert found == pytest.approx(HIGHLIGHT * 0.8 * shine, rel=1e-4, abs=1e-6)


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


def test_one_ray_meets_one_solid_as_the_slow_ones_do() -> None:
    rng, met = np.random.default_rng(7), []
    for _ in range(200):
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        box = np.r_[rng.normal(0, 0.2, 3), axes.ravel(), rng.uniform(0.1, 0.5, 3)][None]
        round_bar = np.r_[box[0, :3], axes[0], np.zeros(6), box[0, 12:14], 0][None]
        origin = 3 * np.linalg.qr(rng.normal(size=(3, 3)))[0][0]
        ray = rng.normal(0, 0.4, 3) - origin
        for shape, hit, slow in ((round_bar, hit_cylinder, slow_cylinder), (box, hit_box, slow_box)):
            wanted = slow(shape[0], origin, ray)
            met.append(np.isfinite(wanted))
            found = hit(shape, 0, *origin, *ray, 1e-6)
            assert found == (pytest.approx(wanted, abs=1e-9) if met[-1] else FAR)
            assert hit(shape, 0, *origin, *ray, found + 1e-6) == FAR
        assert longest_axis(box, 0) == int(np.argmax(box[0, 12:]))
    assert 0.2 < np.mean(met) < 0.8


def test_a_traced_ray_ends_at_its_limit_or_at_any_hit(scene: Scene) -> None:
    rng, cut = np.random.default_rng(8), []
    for _ in range(60):
        origin = np.r_[rng.uniform(0, 1.6), rng.uniform(-1, 1), 4.0]
        ray = np.r_[rng.uniform(0, 1.6), rng.uniform(-1, 1), rng.uniform(0, 0.5)] - origin
        far, (nearest, solid) = rng.uniform(0.5, 1.5), slow_trace(scene, origin, ray)
        cut.append(nearest >= far)
        wanted = (FAR, -1) if cut[-1] else (pytest.approx(nearest, abs=1e-9), solid)
        assert trace(scene, *origin, *ray, 1e-6, far, False) == wanted
        some, found = trace(scene, *origin, *ray, 1e-6, far, True)
        assert (found >= 0) == (not cut[-1]) and (found < 0 or nearest - 1e-9 <= some < far)
    assert 0.2 < np.mean(cut) < 0.8


def test_a_lamps_beam_ends_smoothly() -> None:
    lamps = hall_lamps(8.0)
    assert lamp_beam(lamps, 0.0) == lamps.power
    assert lamp_beam(lamps, -3.75) == lamp_beam(lamps, 3.75) == pytest.approx(0.5625 * lamps.power)
    assert lamp_beam(lamps, 7.49) < 1e-4 * lamps.power and lamp_beam(lamps, 7.5) == 0
