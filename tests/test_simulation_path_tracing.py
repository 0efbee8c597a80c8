"""Path tracing of a yard: meshes lie on the primitives, light agrees with the yard's own renderer."""

import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from barsight.core.arrays import Float32
from barsight.core.errors import ConfigError
from barsight.core.pose import Pose
from barsight.simulation.effects.settings import LightSettings
from barsight.simulation.lighting import Lamps, bake, hall_lamps
from barsight.simulation.path_tracing import MeshPart, PathTracer, box, end_faces, tube
from barsight.simulation.render import Shading, render_view
from barsight.simulation.scene import Primitives, Scene, build_grid
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.textures import TILE, surface_tile

NEEDS_MITSUBA = pytest.mark.skipif(
    find_spec("mitsuba") is None, reason="Mitsuba isn't installed (extra mitsuba; it needs libllvm19)"
)
UP, Y, X = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
PLAIN: Float32 = np.tile(np.array([1.0, 1.0, 0.0, 1.0], np.float32), (TILE, TILE, 1))
DOWN = Pose("yard", "cam", np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 4.0]))


def yard(gloss: float = 0.0) -> Primitives:
    """A bar of 100 mm and 1 m on the floor, and a block of 0.2 m beside it."""
    bar = np.concatenate([[0.0, 0.0, 0.05], Y, UP, X, [0.05, 0.5, 0.0]])
    block = np.concatenate([[0.5, 0.0, 0.1], X, Y, UP, [0.1, 0.2, 0.1]])
    material = np.array(
        [[0.3, gloss, 1.0, 2.0, 0.05, 1.1, 0, 1, 0, 1], [0.4, 0, 0.5, 0.2, 0, 1, 0, 0.8, 0, 1]]
    )
    return Primitives(np.array([bar, block]), material.astype(np.float32), 1)


def faces_out(part: MeshPart) -> bool:
    a, b, c = (part.points[part.faces[:, k]] for k in range(3))
    return bool((np.einsum("ij,ij->i", np.cross(b - a, c - a), part.normals[part.faces[:, 0]]) > 0).all())


def test_meshes_lie_on_their_primitives() -> None:
    round_side, ends, block = tube(yard(), 0), end_faces(yard(), 0), box(yard(), 1)
    assert all(faces_out(part) for part in (round_side, ends, block))
    assert np.hypot(round_side.points[:, 0], round_side.points[:, 2] - 0.05) == pytest.approx(0.05)
    assert np.abs(ends.points[:, 1]) == pytest.approx(0.5)
    assert np.abs(block.points - [0.5, 0.0, 0.1]) == pytest.approx(np.tile([0.1, 0.2, 0.1], (24, 1)))


@pytest.mark.parametrize("side", [-1, 1])
def test_texture_runs_as_in_the_renderer(side: int) -> None:
    """At 90 degrees to either side and the far end: r angle + twist s + offset around, in tiles."""
    part = tube(yard(), 0)
    at = np.flatnonzero((part.points[:, 1] > 0) & (side * part.points[:, 0] > 0.0499))
    around, along = (side * 0.05 * np.pi / 2 + 0.05 * 0.5 + 1) / 0.0015, (0.5 * 1.1 + 2) / 0.002
    assert part.texture[at] * TILE == pytest.approx(np.array([[along, around]]) + 0.5, rel=1e-6)


def rays(half: float, count: int = 48, side: int = 2) -> Float32:
    """Rays of a camera that sees `half` times its height to either side."""
    place = 2 * half * ((np.arange(count * side) + 0.5) / (count * side) - 0.5)
    return np.stack(np.meshgrid(place, place), axis=-1).astype(np.float32)


def pictures(gloss: float, half: float, tile: Float32) -> tuple[Float32, Float32]:
    lamps = hall_lamps(4.0, LightSettings(ambient=0.5, bounce_ratio=0.3))
    primitives = yard(gloss)
    scene = Scene(primitives, build_grid(primitives, (0.1, 0.5)))
    tracer = PathTracer(primitives, lamps, tile, 64)
    look = Shading(lamps, bake(scene, lamps, np.random.default_rng(0)), tile)
    return render_view(scene, look, rays(half), 2, DOWN), tracer.render(rays(half), 2, DOWN, 2_000_000)


@NEEDS_MITSUBA
@pytest.mark.slow
@pytest.mark.parametrize("gloss", [0.0, 1.0])
def test_light_and_highlight_agree_with_the_renderer(gloss: float) -> None:
    ours, traced = pictures(gloss, 0.5, PLAIN)
    floor, bar = (slice(2, 46), slice(2, 10)), (slice(20, 28), slice(23, 25))
    assert traced[floor].mean() == pytest.approx(ours[floor].mean(), rel=0.05)
    assert traced[bar].mean() == pytest.approx(ours[bar].mean(), rel=0.15)


@NEEDS_MITSUBA
@pytest.mark.slow
@pytest.mark.parametrize("gloss", [0.0, 1.0])
def test_textures_agree_with_the_renderer(gloss: float) -> None:
    """On both sides of the bar's crest, on the floor and on the block."""
    ours, traced = pictures(gloss, 0.15, surface_tile(np.random.default_rng(1), 0.025))
    for part in (slice(20, 24), slice(24, 28), slice(2, 16), slice(40, 47)):
        one, two = (np.log(picture[2:46, part]) for picture in (ours, traced))
        one, two = (part - part.mean(axis=0) for part in (one, two))
        assert np.corrcoef(one.ravel(), two.ravel())[0, 1] > 0.8


def test_what_is_not_drawn_is_named() -> None:
    primitives, lamps = yard(), hall_lamps(4.0)
    ribbed = primitives.material.copy()
    ribbed[0, 6] = 0.05
    with pytest.raises(ConfigError, match="ribbed bars"):
        PathTracer(primitives._replace(material=ribbed), lamps, PLAIN, 16)
    with pytest.raises(ConfigError, match="the sun"):
        PathTracer(primitives, hall_lamps(4.0, LightSettings(sun_ratio=1.0)), PLAIN, 16)


def test_without_mitsuba_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    lamps: Lamps = hall_lamps(4.0)
    with pytest.raises(ConfigError, match=r"barsight\[mitsuba\]"):
        PathTracer(yard(), lamps, PLAIN, 16)


def test_a_yard_that_is_too_large_is_refused() -> None:
    primitives = yard()
    primitives.shape[0, 1] = 300.0
    with pytest.raises(ConfigError, match="shorten it"):
        PathTracer(primitives, hall_lamps(4.0), PLAIN, 16)


def test_paths_are_a_square() -> None:
    with pytest.raises(ConfigError, match="square"):
        replace(SimulationSettings(), paths=60)
