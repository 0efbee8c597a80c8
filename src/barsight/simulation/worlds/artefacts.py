"""Lay the artefacts of an acceptance plan instead of a stock: plates, spheres on posts, dummy bundles."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from barsight.artefacts.plan import AcceptancePlan, DummyBundle, Plate, Sphere
from barsight.core.arrays import Float64
from barsight.core.errors import ConfigError
from barsight.simulation.scene import Primitives, Scene, build_grid, build_scene, plain_material
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.yard import BARS_OF_RINGS, BarKind
from barsight.simulation.simulate import LaidYard, stream
from barsight.simulation.stock import StackedBundle, Stock, hexagonal_packing
from barsight.simulation.truth import bundle_rows

POST_M = 0.04
"""Half the side of a post that carries a sphere, m."""
CELL_M = (0.1, 0.5)
SPECKLED = 2.5
"""Contrast of a sphere's speckles relative to the texture of a bare surface."""


def lay_artefacts(plan: AcceptancePlan, settings: SimulationSettings) -> LaidYard:
    """Lay the artefacts exactly where the plan puts them, each on a block or post that reaches the floor. The
    bars of a dummy bundle end flush.

    Raises ConfigError for a dummy bundle whose number of bars isn't that of a hexagonal packing, or whose
    figures contradict it.
    """
    rng = stream(settings, 13)
    bundles = tuple(_bundle(one) for one in plan.dummy_bundle)
    flush = replace(settings, yard=replace(settings.yard, uneven_ends_m=0.0))
    scene = build_scene(Stock(bundles, ()), flush, stream(settings, 1))
    boxes = [_block(one) for one in plan.plate]
    for sphere in plan.sphere:
        boxes += _on_post(sphere)
    materials = [plain_material(0.4, 0.0, rng, weight=SPECKLED if box[13] == 0 else 1.0) for box in boxes]
    shape = np.concatenate([scene.primitives.shape, np.reshape(boxes, (-1, 15))])
    material = np.concatenate([scene.primitives.material, np.reshape(materials, (-1, 10))])
    primitives = Primitives(shape, material.astype(np.float32), scene.primitives.cylinders)
    return LaidYard(
        Scene(primitives, build_grid(primitives, CELL_M)),
        {"bundles.json": bundle_rows(bundles), "artefacts.json": asdict(plan)},
    )


def _block(plate: Plate) -> Float64:
    c, s = np.cos(np.radians(plate.yaw_deg)), np.sin(np.radians(plate.yaw_deg))
    centre = [plate.x_m, plate.y_m, plate.z_m / 2]
    half = [plate.size_m[0] / 2, plate.size_m[1] / 2, plate.z_m / 2]
    return np.array([*centre, c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0, *half])


def _on_post(sphere: Sphere) -> list[Float64]:
    """Build the sphere and, unless it lies on the floor, the post below it."""
    radius = sphere.diameter_m / 2
    axes = np.eye(3).ravel()
    made = [np.array([sphere.x_m, sphere.y_m, sphere.z_m, *axes, radius, 0.0, 0.0])]
    top = sphere.z_m - 0.9 * radius
    if top > 0.05:
        made.append(np.array([sphere.x_m, sphere.y_m, top / 2, *axes, POST_M, POST_M, top / 2]))
    return made


def _bundle(dummy: DummyBundle) -> StackedBundle:
    if dummy.bars not in BARS_OF_RINGS:
        raise ConfigError(f"{dummy.name}: {dummy.bars} bars make no hexagonal packing; {BARS_OF_RINGS} do")
    kind = BarKind(dummy.bar_diameter_m, dummy.bars)
    cross = hexagonal_packing(kind)
    centre = np.array([dummy.x_m, dummy.y_m, -cross[:, 1].min() + kind.diameter_m / 2])
    laid = StackedBundle(
        0, 0, 0, kind, centre, float(np.radians(dummy.yaw_deg)), 0.0, cross, dummy.length_m, False, True
    )
    for what, own, stated in (
        ("width_m", 2 * laid.radius_m, dummy.width_m), ("top_z_m", laid.top_z_m, dummy.top_z_m),
    ):  # fmt: skip
        if abs(own - stated) > 0.002:
            raise ConfigError(
                f"{dummy.name}: {what} of such a bundle on the floor is {own:.4f}, not {stated}"
            )
    return laid
