"""Light and faults change a picture, held against what can be computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from barsight.core.errors import ConfigError
from barsight.simulation.effects.faults import HAZE_GRAY, SpoiledLens, exposure_gain
from barsight.simulation.effects.settings import FaultSettings, LightSettings
from barsight.simulation.lighting import Lamps, bake, hall_lamps, sun_patch
from barsight.simulation.render import DUST_ALBEDO, Shading, shade
from barsight.simulation.scene import Primitives, Scene, build_grid
from barsight.simulation.textures import TILE

STILL = np.zeros(2)


def lens(settings: FaultSettings, seed: int = 0) -> SpoiledLens:
    return SpoiledLens.draw(settings, (60, 80), np.random.default_rng(seed))


def test_motion_smears_along_the_way_and_keeps_the_light() -> None:
    settings = FaultSettings(exposure_s=0.01)
    spot = np.zeros((60, 80), np.float32)
    spot[30, 40] = 1
    smeared = lens(settings).spoil(spot, settings, np.array([600.0, 0.0]))
    assert smeared.sum() == pytest.approx(1, abs=1e-4) and smeared[30].sum() == pytest.approx(1, abs=1e-4)
    columns = np.arange(80)
    assert (smeared[30] * columns).sum() == pytest.approx(40, abs=1e-3)
    spread = (smeared[30] * (columns - 40) ** 2).sum()
    assert spread == pytest.approx(6**2 / 12, rel=0.1)  # of a box 6 px wide
    np.testing.assert_array_equal(lens(settings).spoil(spot, settings, STILL), spot)


def test_haze_takes_contrast() -> None:
    settings = FaultSettings(haze_ratio=0.2)
    gray = np.linspace(0, 1, 4800, dtype=np.float32).reshape(60, 80)
    np.testing.assert_allclose(
        lens(settings).spoil(gray, settings, STILL), 0.8 * gray + 0.2 * HAZE_GRAY, atol=1e-6
    )


def test_dirt_darkens_drops_blur_and_glare_lightens() -> None:
    gray = np.random.default_rng(1).uniform(0.2, 0.6, (60, 80)).astype(np.float32)
    for settings, sign in ((FaultSettings(dirt_spots=3), -1), (FaultSettings(glare_ratio=0.3), 1)):
        change = lens(settings).spoil(gray, settings, STILL) - gray
        assert (sign * change >= -1e-6).all() and 0.05 < np.abs(change).max() <= 0.6
    settings = FaultSettings(drops=2, dirt_px=12)
    one = lens(settings)
    out, inside = one.spoil(gray, settings, STILL), one.drop == 1
    assert inside.sum() > 50 and out[inside].std() < 0.4 * gray[inside].std()
    np.testing.assert_array_equal(out[one.drop == 0], gray[one.drop == 0])


def test_dead_pixels_are_always_the_same() -> None:
    one = lens(FaultSettings(dead_pixels=40))
    pictures = [np.full((60, 80), level, np.uint8) for level in (90, 120)]
    for picture in pictures:
        one.kill(picture)
    dead = pictures[0] != 90
    assert 30 < dead.sum() <= 40 and set(np.unique(pictures[0][dead])) == {0, 255}
    np.testing.assert_array_equal(pictures[0][dead], pictures[1][dead])


def test_exposure_steps_and_flicker_multiply() -> None:
    settings = FaultSettings(exposure_step_ratio=0.1, flicker_ratio=0.02)
    assert exposure_gain(settings, 1.0, np.pi / 2) == pytest.approx(np.exp(0.1) * 1.02)
    assert exposure_gain(FaultSettings(), 2.0, 1.0) == 1


@pytest.mark.parametrize("wrong", [{"exposure_s": 1.0}, {"haze_ratio": 1.0}, {"dead_pixels": -1}])
def test_faults_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        FaultSettings(**wrong)  # type: ignore[arg-type]


def plain_scene(dust: float) -> tuple[Scene, Shading, Lamps]:
    """One bar of 0.1 m along Y over the floor, in the open, under a sun of 30 degrees from +X."""
    light = LightSettings(
        sun_ratio=1.0, sun_elevation_deg=30.0, sun_azimuth_deg=0.0, sun_patch_m=(-1, 1, -1, 1)
    )
    lamps = hall_lamps(8.0, light)
    shape = np.array([[0, 0, 0.3, 0, 1, 0, 0, 0, 1, 1, 0, 0, 0.05, 0.4, 0]], float)
    material = np.array([[0.2, 0, 0, 0, 0, 1, 0, 1, dust, 1]], np.float32)
    primitives = Primitives(shape, material, 1)
    scene = Scene(primitives, build_grid(primitives, (0.1, 0.5)))
    tile = np.broadcast_to(np.array([1, 1, 0, 1], np.float32), (TILE, TILE, 4)).copy()
    return scene, Shading(lamps, bake(scene, lamps, np.random.default_rng(0)), tile), lamps


def test_the_sun_lights_its_patch_and_casts_a_shadow() -> None:
    scene, look, lamps = plain_scene(0.0)
    # Where the patch is cut at a height, it has moved towards the sun by height / tan(elevation).
    assert sun_patch(lamps.sun, 0.99, 0.0, 0.0) == pytest.approx(0.5 + 0.01 / 0.07)
    assert sun_patch(lamps.sun, 0.95 + 0.3 / np.tan(np.radians(30)), 0.0, 0.3) == pytest.approx(1)
    assert sun_patch(lamps.sun, -0.95, 0.0, 0.3) == 0
    dark = look._replace(lightmap=look.lightmap._replace(sun=np.zeros(0, np.float32)))
    floor, eye = 1, (0.0, 0.0, 5.0)
    gains = {}
    for name, x in (("open", 0.6), ("shadow", -0.3 / np.tan(np.radians(30))), ("outside", 1.6)):
        ray = (x, 0.0, -5.0)
        lit = shade(scene.primitives, look, floor, *eye, *ray)
        gains[name] = lit - shade(scene.primitives, dark, floor, *eye, *ray)
    assert gains["open"] == pytest.approx(0.22, rel=0.01)  # the floor's albedo times 1 on a level surface
    assert gains["outside"] == 0 and gains["shadow"] < 0.35 * gains["open"]
    # The bar's side towards the sun gets its light at the cosine of 30 degrees.
    ray = (0.05, 0.0, -4.7)
    gain = shade(scene.primitives, look, 0, *eye, *ray) - shade(scene.primitives, dark, 0, *eye, *ray)
    assert gain == pytest.approx(0.2 * np.cos(np.radians(30)) / np.sin(np.radians(30)), rel=0.05)


def test_dust_lies_on_what_faces_up() -> None:
    clean, look, _ = plain_scene(0.0)
    dusty, _, _ = plain_scene(0.5)
    top, side = (0.0, 0.0, -0.65), (-0.95, 0.0, -0.7)
    above, beside = (0.0, 0.0, 1.0), (1.0, 0.0, 1.0)
    ratio = shade(dusty.primitives, look, 0, *above, *top) / shade(clean.primitives, look, 0, *above, *top)
    assert ratio == pytest.approx((0.2 + 0.5 * (DUST_ALBEDO - 0.2)) / 0.2, rel=1e-6)
    at_side = [shade(s.primitives, look, 0, *beside, *side) for s in (dusty, clean)]
    assert at_side[0] == pytest.approx(at_side[1])
