"""Assign surfaces to a yard's solids: mill scale to polished, rust, oil, dust; sort them for the renderer."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.simulation.scene import CODE, Primitives, Scene, build_grid
from barsight.simulation.worlds.solids import NOTHING, Solid, SolidYard

CELLS_M = (0.09, 0.5)
ALBEDO = {
    "bar": 0.27, "strap": 0.13, "tag": 0.75, "beam": 0.36, "wall": 0.45, "stanchion": 0.2, "cart": 0.3,
    "person": 0.35,
}  # fmt: skip
RIBBED_RATIO = 0.2
RIB_PITCH = 0.7
"""Pitch of the ribs relative to the bar's diameter."""


class Finish(NamedTuple):
    """Ranges (from, to) of albedo, gloss, texture weight, dust, and roughness relative to the ordinary."""

    albedo: tuple[float, float]
    gloss: tuple[float, float]
    texture: tuple[float, float]
    dust: tuple[float, float]
    rough: tuple[float, float]


FINISHES = {
    "mill scale": Finish((0.18, 0.30), (0.2, 0.8), (0.7, 1.3), (0.0, 0.0), (0.9, 1.3)),
    "polished": Finish((0.30, 0.45), (0.8, 2.0), (0.2, 0.6), (0.0, 0.0), (0.5, 0.8)),
    "rusty": Finish((0.18, 0.32), (0.0, 0.2), (0.9, 1.6), (0.0, 0.0), (1.2, 1.6)),
    "oiled": Finish((0.08, 0.16), (0.6, 1.6), (0.4, 1.0), (0.0, 0.0), (0.5, 0.9)),
    "dusty": Finish((0.20, 0.32), (0.1, 0.5), (0.6, 1.2), (0.3, 0.9), (1.0, 1.4)),
}


def draw_finishes(numbers: tuple[int, ...], rng: np.random.Generator) -> dict[int, str]:
    """Draw each bundle's finish by its number: one of FINISHES, mostly the same within a yard."""
    names = list(FINISHES)
    usual = names[int(rng.integers(len(names)))]
    return {
        number: usual if rng.random() < 0.7 else names[int(rng.integers(len(names)))] for number in numbers
    }


def scene_of(
    yard: SolidYard, finishes: dict[int, str], rng: np.random.Generator,
    label_m: tuple[float, float] = (0.0, 0.0),
) -> Scene:  # fmt: skip
    """Assign surfaces to the solids and sort them for the renderer.

    label_m: length and width of the labels that replace the tags, each with the code of its bundle's number
    from 1; 0 0 leaves the tags plain and small.
    """
    looks = {number: _look(FINISHES[name], rng) for number, name in finishes.items()}
    ordered = sorted(yard.solids, key=lambda s: not s.is_round)
    labels = [k for k, s in enumerate(ordered) if s.part == "tag" and max(label_m) > 0]
    for k in labels:
        half = np.array([label_m[1] / 2, label_m[0] / 2, ordered[k].half[2]])
        ordered[k] = replace(ordered[k], half=half)
    shape = np.array([_shape(s) for s in ordered])
    material = np.array([_material(s, looks, rng) for s in ordered], dtype=np.float32)
    material[labels, CODE] = [ordered[k].bundle + 1 for k in labels]
    primitives = Primitives(shape, material, sum(s.is_round for s in ordered))
    return Scene(primitives, build_grid(primitives, CELLS_M))


def owners(yard: SolidYard) -> Int64:
    """Return the bundle of each primitive of `scene_of` (P + 1,), ending with NOTHING for the floor."""
    ordered = sorted(yard.solids, key=lambda s: not s.is_round)
    return np.array([*(s.bundle for s in ordered), NOTHING])


def _look(finish: Finish, rng: np.random.Generator) -> tuple[float, float, float, float, float, bool]:
    """Draw a bundle's albedo, gloss, texture, dust, roughness, and whether its bars are ribbed."""
    values = [float(rng.uniform(*limits)) for limits in finish]
    return values[0], values[1], values[2], values[3], values[4], bool(rng.random() < RIBBED_RATIO)


def _shape(solid: Solid) -> Float64:
    sizes = [solid.half[1], solid.half[0], 0.0] if solid.is_round else solid.half
    return np.concatenate([solid.centre, solid.axes.ravel(), sizes])


def _material(
    solid: Solid, looks: dict[int, tuple[float, float, float, float, float, bool]], rng: np.random.Generator
) -> list[float]:
    offsets, scale = rng.uniform(0, 10, 2), float(rng.uniform(0.85, 1.15))
    shade = float(np.exp(rng.normal(0, 0.12)))
    if solid.part == "bar" and solid.bundle in looks:
        albedo, gloss, texture, dust, rough, ribbed = looks[solid.bundle]
        twist = float(rng.choice([-1, 1]) * rng.uniform(0.04, 0.08))
        pitch = RIB_PITCH * 2 * float(solid.half[1]) if ribbed else 0.0
        gloss *= float(np.exp(rng.normal(0, 0.25)))
        return [albedo * shade, gloss, *offsets, twist, scale, pitch, texture, dust, rough]
    gloss = {"strap": 0.5, "stanchion": 0.3}.get(solid.part, 0.0)
    weight = 0.3 if solid.part == "tag" else 1.0
    return [ALBEDO[solid.part] * shade, gloss, *offsets, 0.0, scale, 0.0, weight, 0.0, 1.0]
