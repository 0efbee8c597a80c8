"""Turn drawn worlds into the input of lift planning: a recording to be measured, or a map with noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from barsight.benchmarks.lift_judge.envelopes import Envelope, envelope
from barsight.benchmarks.lift_judge.magnet import JudgedMagnet
from barsight.core.arrays import UInt8
from barsight.core.records.heights import HeightSource
from barsight.result_folder import read_heights, read_summary
from barsight.simulation.passes import simulate_passes
from barsight.simulation.render import FLOOR_ALBEDO
from barsight.simulation.scene import Scene
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.travel import PassesSettings
from barsight.simulation.simulate import LaidYard, simulate
from barsight.simulation.worlds.conditions import draw_conditions
from barsight.simulation.worlds.solids import NOTHING
from barsight.simulation.worlds.surfaces import ALBEDO, draw_finishes, scene_of
from barsight.simulation.worlds.yards import DrawnYard, draw_yard
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.lift import LiftScene
from barsight.yard.lifting.targets import map_vetoes
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.footprint import BundleTable
from barsight.yard.stability.stability import footings
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Veto

SPAN_M = 3.0
"""Approximate extent along X of the yards on which lifts are judged, m."""
SMALL = CameraSettings(width_px=640, height_px=512, focal_px=625.0)
"""Cameras with half the usual picture size."""
OVER_MAGNET_M = 0.3
"""Length of their bars beyond the magnet's span, m."""
CELL_M, MARGIN_M = 0.01, 0.6
WHITE_M, ALIKE_M, ALIKE_CELLS = 0.001, 0.0015, 3.0
"""Noise of `noisy_world`: sigma of the white noise, m; sigma, m, and smoothing, cells, of the other."""
WHITE_LEVEL = 300.0
"""Gray level of an albedo of 1 in the photo of `noisy_world`."""


def judged_yard(seed: int, magnet: JudgedMagnet, kind: str | None = None) -> DrawnYard:
    """Draw a seed's yard for judging lifts of a magnet: its bars are slightly longer than the magnet."""
    return draw_yard(seed, 2 * magnet.half_span_m + OVER_MAGNET_M, SPAN_M, min_length_ratio=1.0, kind=kind)


def drawn_scene(world: DrawnYard) -> Scene:
    """Assign surfaces to the solids and sort them for the renderer."""
    rng = np.random.default_rng((29, world.seed))
    return scene_of(world.yard, draw_finishes(world.yard.bundles, rng), rng)


def recording_settings(world: DrawnYard, *, full_size: bool = False) -> SimulationSettings:
    """Draw the conditions of a world's short recording: light, texture, mounting, crane, sensors and image
    faults. Images are small or full-size ones: ten pairs for 3 m.
    """
    length, camera = world.size_m[0], CameraSettings() if full_size else SMALL
    given = SimulationSettings(length, round(3 + 2.3 * length), depth_views=0, camera=camera)
    return draw_conditions(world.seed, given, hides=world.hides)


def render_world(
    world: DrawnYard, recording: Path, *, full_size: bool = False, trolley_y_m: tuple[float, ...] = ()
) -> None:
    """Render a recording of a world, or one of each pass (pass_1, pass_2) at these trolley positions."""
    settings, laid = recording_settings(world, full_size=full_size), LaidYard(drawn_scene(world), {})
    if trolley_y_m:
        simulate_passes(recording, replace(settings, passes=PassesSettings(trolley_y_m)), laid=laid)
    else:
        simulate(recording, settings, laid=laid)


@dataclass(frozen=True, eq=False)
class MappedWorld:
    """The whole input of lift planning. vetoes: those that apply to the whole map."""

    scene: LiftScene
    vetoes: tuple[Veto, ...]


def measured_world(out: Path, settings: LiftSettings) -> MappedWorld:
    """Read the input of lift planning from a measured folder, as of its last frame."""
    summary = read_summary(out)
    travel = Travel.read(summary)
    captured = travel.captured_ns if travel else None
    now_ns = captured[1] if captured else 0
    warnings = [(str(w["code"]), str(w["message"])) for w in summary["warnings"]]
    vetoes = map_vetoes(warnings, summary["reference"], now_ns, now_ns, settings, has_magnet=True)
    heights = read_heights(out).whole()
    return map_world(heights, read_bundles(out / "bundles.json"), vetoes, travel, now_ns, settings)


def exact_heights(world: DrawnYard) -> Envelope:
    """Compute the exact height of every cell of a world and a margin around it."""
    (x, y), margin = world.size_m, MARGIN_M
    return envelope(world.yard, (-margin, -y / 2 - margin), (x + margin, y / 2 + margin), step=CELL_M)


def noisy_world(world: DrawnYard, settings: LiftSettings) -> MappedWorld:
    """Add noise to the exact height of every cell and detect the bundles in the result. Every cell is
    seen, nothing is smoothed, and no travel is known. Lifts are chosen with the yard's photo too: nothing
    else shows labels.
    """
    rng = np.random.default_rng((31, world.seed))
    drawn = exact_heights(world)
    alike = ndimage.gaussian_filter(rng.normal(0, 1, drawn.z.T.shape), ALIKE_CELLS)
    noise = WHITE_M * rng.normal(0, 1, alike.shape) + ALIKE_M * alike / alike.std()
    z = (drawn.z.T + noise).astype(np.float32)
    sigma = np.full_like(z, np.hypot(WHITE_M, ALIKE_M))
    vision = np.full(z.shape, HeightSource.VISION, np.uint8)
    heights = HeightMap(drawn.x0, drawn.y0, CELL_M, z, sigma, np.full_like(z, 6.0), vision)
    bundles = find_bundles(heights, BundleSettings())
    return map_world(replace(heights, gray=_photo(world, drawn)), bundles, (), None, 0, settings)


def _photo(world: DrawnYard, drawn: Envelope) -> UInt8:
    """Draw the photo (rows, columns) of a yard: each surface has the level of its kind's albedo."""
    albedo = np.array([ALBEDO[solid.part] for solid in world.yard.solids])[drawn.top.T]
    albedo[drawn.top.T == NOTHING] = FLOOR_ALBEDO
    return np.asarray((WHITE_LEVEL * albedo).round(), np.uint8)


def map_world(
    heights: HeightMap, bundles: tuple[Bundle, ...], vetoes: tuple[Veto, ...], travel: Travel | None,
    now_ns: int, settings: LiftSettings,
) -> MappedWorld:  # fmt: skip
    """Assemble the input of lift planning."""
    stands = footings(heights, bundles, settings)
    return MappedWorld(LiftScene(heights, BundleTable.of(bundles), stands, travel, now_ns), vetoes)
