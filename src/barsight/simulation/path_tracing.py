"""Trace paths through the yard with Mitsuba 3: area lamps, light between bars, shadows of the hall's light.

Geometry, textures, rays and the lamps' places are those of `render_view`. Lamps are rectangles without a
beam, albedo and gloss are rounded, and what `bounce_ratio` stands for is traced.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from barsight.core.arrays import Float32, Float64, Int64
from barsight.core.errors import ConfigError
from barsight.core.pose import Pose
from barsight.simulation.lighting import Lamps, lamp_beam
from barsight.simulation.render import FLOOR_ALBEDO, HIGHLIGHT, SPREAD_ALONG, SPREAD_AROUND
from barsight.simulation.scene import CODE, Primitives, primitive_bounds
from barsight.simulation.textures import ALONG_M, AROUND_M, TILE

FACETS = 72
"""Number of facets around a bar: with normals between them they deviate by a thousandth of the radius."""
HALF_TEXEL = 0.5
"""Place of a texel's centre in Mitsuba's bitmaps; in `render_view` it is at 0."""
ALBEDO_STEP, GLOSS_STEP = 0.1, 0.2
"""Steps of the logarithms of albedo and gloss by which bars share a material."""
LAMP_WIDTH_M = 0.2
FLOOR_MARGIN_M, MAX_FLOOR_M2 = 6.0, 800.0
"""Margin of the floor around the stack, and its maximum area: a square metre takes 1 MB."""
CHUNK = 4_000_000
"""Number of paths that are traced at once."""
MAX_DEPTH = 6
"""Maximum number of segments of a path."""
MIN_LLVM = 16
"""Minimum version of LLVM: 15 lacks an instruction and aborts."""
REMEDY = "install barsight[mitsuba] and LLVM (Debian's libllvm19)"
END_FACE_RATIO = 0.7
"""Albedo of a bar's end face relative to its side's, as `shade` has it."""


class MeshPart(NamedTuple):
    """Triangles. points, normals: (V, 3), yard, m. texture: (V, 2) along and around, in tiles. faces: (F, 3)
    numbers of points, counter-clockwise seen from outside.
    """

    points: Float64
    normals: Float64
    texture: Float64
    faces: Int64


class PathTracer:
    """A yard ready to be path-traced. paths: number per ray of `sample_rays`. seed: of the paths' noise."""

    def __init__(
        self, primitives: Primitives, lamps: Lamps, tile: Float32, paths: int, seed: int = 0
    ) -> None:
        _expect_known(primitives, lamps)
        self._mi = _mitsuba()
        self._paths, self._seed = paths, seed
        parts: dict[str, Any] = {"type": "scene"}
        for number, shape in enumerate(self._shapes(primitives, tile)):
            parts[f"shape{number}"] = shape
        for number, lamp in enumerate(_lamp_shapes(self._mi, primitives, lamps)):
            parts[f"lamp{number}"] = lamp
        parts["hall"] = {"type": "constant", "radiance": lamps.ambient / np.pi}
        self._scene = self._mi.load_dict(parts)
        self._integrator = self._mi.load_dict({"type": "path", "max_depth": MAX_DEPTH})

    def render(self, rays: Float32, side: int, yard_from_cam: Pose, number: int) -> Float32:
        """Render the radiance (H, W), about 1 for white paper under the lamps; see `render_view`.

        number: of the picture, whose noise is its own.
        """
        mi = self._mi
        directions = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1).reshape(-1, 3)
        directions = directions @ yard_from_cam.rotation.T.astype(np.float32)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        eye = mi.Point3f(*(float(v) for v in yard_from_cam.translation))
        light = np.empty(len(directions), np.float32)
        for first in range(0, len(directions), CHUNK // self._paths):
            part = directions[first : first + CHUNK // self._paths]
            sampler = mi.load_dict({"type": "multijitter", "sample_count": self._paths})
            sampler.set_samples_per_wavefront(self._paths)
            noise = np.random.SeedSequence((self._seed, number, first)).generate_state(1)
            sampler.seed(int(noise[0]), len(part) * self._paths)
            repeated = np.repeat(part, self._paths, axis=0)
            ray = mi.Ray3f(eye, mi.Vector3f(repeated.T))
            found, _, _ = self._integrator.sample(self._scene, sampler, ray)
            light[first : first + len(part)] = np.asarray(found[0]).reshape(-1, self._paths).mean(axis=1)
        shape = rays.shape[0] // side, side, rays.shape[1] // side, side
        return np.asarray(np.pi * light.reshape(shape).mean(axis=(1, 3)), np.float32)

    def _shapes(self, primitives: Primitives, tile: Float32) -> Iterator[Any]:
        """Yield one mesh for all primitives that share a material, and the floor."""
        shape, material, cylinders = primitives
        groups: dict[tuple[float, ...], list[MeshPart]] = {}
        for p in range(len(shape)):
            albedo, gloss, weight, rough = (float(material[p, k]) for k in (0, 1, 7, 9))
            steps = round(np.log(albedo) / ALBEDO_STEP), round(np.log(max(gloss, 1e-9)) / GLOSS_STEP)
            if p >= cylinders:
                groups.setdefault((steps[0], np.inf, weight, 1.0), []).append(box(primitives, p))
                continue
            groups.setdefault((*steps, weight, rough), []).append(tube(primitives, p))
            ends = round(np.log(END_FACE_RATIO * albedo) / ALBEDO_STEP)
            groups.setdefault((ends, np.inf, 1.0, 1.0), []).append(end_faces(primitives, p))
        for (albedo_step, gloss_step, weight, rough), parts in sorted(groups.items()):
            albedo = np.exp(ALBEDO_STEP * albedo_step) * (1 + weight * (tile[..., 0] - 1))
            surface = {"type": "diffuse", "reflectance": self._bitmap(albedo)}
            if np.isfinite(gloss_step):
                gloss = np.exp(GLOSS_STEP * gloss_step)
                surface = self._glossy(surface, gloss * tile[..., 1], rough, weight * tile[..., 2])
            yield self._mesh(join_parts(parts), surface)
        yield self._floor(primitives, tile)

    def _glossy(
        self, diffuse: dict[str, Any], gloss: Float32, rough: float, slope: Float32
    ) -> dict[str, Any]:
        """Add a highlight [Ward 1992] as a Beckmann lobe of the same width and peak, on a rippled surface.

        The lobe's peak is E / (4 alpha_u alpha_v), that of `render_view` HIGHLIGHT E.
        """
        alpha_u, alpha_v = SPREAD_ALONG * rough, SPREAD_AROUND * rough
        share = np.clip(HIGHLIGHT * 4 * alpha_u * alpha_v * gloss, 0, 1)
        metal = {"type": "roughconductor", "distribution": "beckmann", "alpha_u": alpha_u, "alpha_v": alpha_v}
        blend = {"type": "blendbsdf", "weight": self._bitmap(share), "diffuse": diffuse, "metal": metal}
        normals = np.stack([np.zeros_like(slope), -np.sin(slope), np.cos(slope)], axis=-1)
        return {"type": "normalmap", "normalmap": self._bitmap(0.5 + 0.5 * normals), "bsdf": blend}

    def _bitmap(self, values: Float32 | Float64) -> dict[str, Any]:
        data = np.ascontiguousarray(np.clip(values, 0, 1).reshape(*values.shape[:2], -1), np.float32)
        return {"type": "bitmap", "data": self._mi.TensorXf(data), "raw": True}

    def _mesh(self, part: MeshPart, surface: dict[str, Any]) -> Any:
        mi = self._mi
        given = mi.Properties()
        given["surface"] = mi.load_dict(surface)
        mesh = mi.Mesh(
            "part", len(part.points), len(part.faces), has_vertex_normals=True, has_vertex_texcoords=True,
            props=given,
        )  # fmt: skip
        values = mi.traverse(mesh)
        for name, array in (
            ("positions", part.points),
            ("normals", part.normals),
            ("texcoords", part.texture),
        ):
            values[f"vertex_{name}"] = array.astype(np.float32).ravel()
        values["faces"] = part.faces.astype(np.uint32).ravel()
        values.update()
        return mesh

    def _floor(self, primitives: Primitives, tile: Float32) -> Any:
        """Build the floor with both of its textures in one bitmap."""
        low, high = _floor_bounds(primitives)
        count = np.ceil((high - low) / ALONG_M).astype(int)
        x, y = (low[k] + ALONG_M * (np.arange(count[k]) + 0.5) for k in (0, 1))
        albedo = np.empty((len(y), len(x)), np.float32)
        wide = 7.3 * ALONG_M
        for row, at in enumerate(y):
            fine = _texels(tile, x / ALONG_M, at / ALONG_M)
            albedo[row] = FLOOR_ALBEDO * fine * _texels(tile, (x + 0.31 * at) / wide, (at - 0.31 * x) / wide)
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
        points = np.column_stack([low + corners * (count * ALONG_M), np.zeros(4)])
        part = MeshPart(points, np.tile([0.0, 0.0, 1.0], (4, 1)), corners, np.array([[0, 1, 2], [0, 2, 3]]))
        return self._mesh(part, {"type": "diffuse", "reflectance": self._bitmap(albedo)})


def _mitsuba() -> Any:
    """Import Mitsuba with the LLVM variant that traces one channel."""
    try:
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_mono")
        version = drjit.detail.llvm_version()
    except ImportError as error:
        raise ConfigError(f"Mitsuba can't start ({error}): {REMEDY}") from error
    if version[0] < MIN_LLVM:
        raise ConfigError(f"Mitsuba found LLVM {version[0]}, which is too old: {REMEDY}")
    return mitsuba


def _expect_known(primitives: Primitives, lamps: Lamps) -> None:
    """Raise ConfigError if the scene has what isn't converted, or is too large."""
    shape, material, cylinders = primitives
    unknown = {
        "spheres (give no --artefacts with spheres)": bool((shape[cylinders:, 13] == 0).any()),
        "ribbed bars (set --yard.ribbed-ratio 0)": bool((material[:cylinders, 6] > 0).any()),
        "dust": bool((material[:cylinders, 8] > 0).any()),
        "labels with codes (set --yard.label-m 0 0)": bool((material[cylinders:, CODE] > 0).any()),
        "the sun (set --light.sun-ratio 0)": bool(lamps.sun[7] > 0),
    }
    named = [name for name, there in unknown.items() if there]
    if named:
        raise ConfigError(f"Mitsuba isn't given {', '.join(named)}")
    low, high = _floor_bounds(primitives)
    if np.prod(high - low) > MAX_FLOOR_M2:
        area = f"{np.prod(high - low):.0f} m2 of floor, and path tracing takes {MAX_FLOOR_M2:.0f}"
        raise ConfigError(f"the yard with its margin has {area}: shorten it (--length)")


def _floor_bounds(primitives: Primitives) -> tuple[Float64, Float64]:
    """Compute the lowest and highest corner (2,) of the floor around the stack."""
    low, high = primitive_bounds(primitives)
    return low.min(axis=0)[:2] - FLOOR_MARGIN_M, high.max(axis=0)[:2] + FLOOR_MARGIN_M


def _lamp_shapes(mi: Any, primitives: Primitives, lamps: Lamps) -> Iterator[dict[str, Any]]:
    """Yield the lamps that reach the stack, as rectangles that shine downwards.

    They have no beam that narrows along X as `lamp_beam` does, and less power instead, so that the floor in
    the middle of the stack is as bright.
    """
    low, high = _floor_bounds(primitives)
    first, last = low[0] + FLOOR_MARGIN_M, high[0] - FLOOR_MARGIN_M
    reach = 1.5 * lamps.spacing
    numbers = np.arange(
        np.ceil((first - reach - lamps.offset) / lamps.spacing), (last + reach - lamps.offset) / lamps.spacing
    )
    away = lamps.offset + lamps.spacing * numbers - (first + last) / 2
    square = away**2 + lamps.rows[:, None] ** 2 + lamps.z**2
    beam = np.array([lamp_beam(lamps, float(one)) for one in away])
    power = float((beam / square**2).sum() / (1 / square**2).sum())
    for row in lamps.rows.tolist():
        for number in numbers.tolist():
            place = [lamps.offset + lamps.spacing * number, row, lamps.z]
            size = [LAMP_WIDTH_M / 2, lamps.half_length, 1.0]
            area = 2 * LAMP_WIDTH_M * lamps.half_length
            yield {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate(place).rotate([1, 0, 0], 180).scale(size),
                "emitter": {"type": "area", "radiance": power / area},
            }


def _texels(tile: Float32, a: Float64, b: Float64) -> Float32:
    """Interpolate the tile's last channel at texels a, b bilinearly, as `render_view` does."""
    a, b = np.broadcast_arrays(a, b)
    i, j = np.floor(a).astype(np.int64), np.floor(b).astype(np.int64)
    wa, wb = (a - i).astype(np.float32), (b - j).astype(np.float32)
    pattern, mask = tile[..., 3], TILE - 1
    i, j, i1, j1 = i & mask, j & mask, (i + 1) & mask, (j + 1) & mask
    low = pattern[i, j] * (1 - wb) + pattern[i, j1] * wb
    high = pattern[i1, j] * (1 - wb) + pattern[i1, j1] * wb
    return np.asarray(low * (1 - wa) + high * wa, np.float32)


def join_parts(parts: Iterable[MeshPart]) -> MeshPart:
    """Join meshes into one."""
    given = list(parts)
    starts = np.cumsum([0, *(len(part.points) for part in given[:-1])])
    faces = [part.faces + start for part, start in zip(given, starts, strict=True)]
    points, normals, texture = (np.concatenate([part[k] for part in given]) for k in range(3))
    return MeshPart(points, normals, texture, np.concatenate(faces))


def tube(primitives: Primitives, p: int) -> MeshPart:
    """Build the round side of cylinder `p`, with the seam of its texture where `shade` has it."""
    shape, material = primitives.shape[p], primitives.material[p]
    radius, half = shape[12:14]
    angle = np.linspace(-np.pi, np.pi, FACETS + 1)
    normals = np.cos(angle)[:, None] * shape[6:9] + np.sin(angle)[:, None] * shape[9:12]
    ends = np.array([-half, half])
    points = shape[:3] + ends[:, None, None] * shape[3:6] + radius * normals
    along = (ends * material[5] + material[3]) / ALONG_M
    around = (radius * angle + material[4] * ends[:, None] + material[2]) / AROUND_M
    texture = (np.stack(np.broadcast_arrays(along[:, None], around), axis=-1) + HALF_TEXEL) / TILE
    low = np.arange(FACETS)
    high = low + FACETS + 1
    faces = np.stack([low, low + 1, high + 1, low, high + 1, high], axis=1).reshape(-1, 3)
    return MeshPart(points.reshape(-1, 3), np.tile(normals, (2, 1)), texture.reshape(-1, 2), faces)


def end_faces(primitives: Primitives, p: int) -> MeshPart:
    """Build both end faces of cylinder `p`."""
    shape = primitives.shape[p]
    radius, half = shape[12:14]
    angle = 2 * np.pi * np.arange(FACETS) / FACETS
    e, f = radius * np.cos(angle), radius * np.sin(angle)
    rim = e[:, None] * shape[6:9] + f[:, None] * shape[9:12]
    texture = (np.stack([f / ALONG_M, e / AROUND_M + 37.0 * p], axis=1) + HALF_TEXEL) / TILE
    low = np.arange(1, FACETS - 1)
    fan = np.stack([np.zeros_like(low), low, low + 1], axis=1)
    parts = []
    for side, faces in ((1.0, fan), (-1.0, fan[:, ::-1])):
        outwards = side * shape[3:6]
        points = shape[:3] + half * outwards + rim
        parts.append(MeshPart(points, np.tile(outwards, (FACETS, 1)), texture, faces))
    return join_parts(parts)


def box(primitives: Primitives, p: int) -> MeshPart:
    """Build the six faces of box `p`, whose texture runs along its longest axis."""
    shape, material = primitives.shape[p], primitives.material[p]
    axes, half = shape[3:12].reshape(3, 3), shape[12:15]
    longest = int(np.argmax(half))
    parts = []
    for face in range(3):
        one, two = (face + 1) % 3, (face + 2) % 3
        for side in (-1.0, 1.0):
            local = np.zeros((4, 3))
            local[:, face] = side * half[face]
            local[:, one] = half[one] * side * np.array([-1, 1, 1, -1])
            local[:, two] = half[two] * np.array([-1, -1, 1, 1])
            along = local[:, longest]
            around = local.sum(axis=1) - along
            texture = np.stack([(along + material[3]) / ALONG_M, (around + material[2]) / AROUND_M], axis=1)
            normals = np.tile(side * axes[face], (4, 1))
            faces = np.array([[0, 1, 2], [0, 2, 3]])
            texture = (texture + HALF_TEXEL) / TILE
            parts.append(MeshPart(shape[:3] + local @ axes, normals, texture, faces))
    return join_parts(parts)
