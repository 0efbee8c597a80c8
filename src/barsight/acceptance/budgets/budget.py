"""Budget the uncertainty of the figures that a crane uses by GUM, and verify it by sampling (JCGM 101)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan

import numpy as np

from barsight.acceptance.observation import ViewGeometry
from barsight.acceptance.uncertainty import COVERAGE, CombinedUncertainty, UncertaintyPart, combine
from barsight.core.arrays import Float64
from barsight.core.pose import skew

FIGURES = (
    ("lift x", "mm", 1e3), ("lift y", "mm", 1e3), ("lift z", "mm", 1e3), ("yaw", "deg", 180 / np.pi),
    ("height", "mm", 1e3), ("width", "mm", 1e3), ("mass", "kg", 1.0),
)  # fmt: skip
"""Names, units and SI-to-unit factors of the budgeted figures."""
ERRORS = (
    "yaw", "baseline", "focal", "turn_x", "turn_y", "turn_z", "move_x", "move_y", "move_z",
    "fit_along", "fit_across", "fit_top", "fit_yaw", "fit_height", "fit_width", "fit_mass",
    "magnet_x", "magnet_y", "magnet_z",
)  # fmt: skip
"""Errors that the model accepts: of the rig, of the yard frame, of the bundle's fit (fit_height: of a single
cell) and of the magnet relative to the camera.
"""
RIG, FRAME = ERRORS[:3], ERRORS[3:9]


@dataclass(frozen=True, eq=False)
class ErrorSource:
    """A source of errors.

    errors: which of `ERRORS` it causes. covariance: theirs, in SI units; NaN where unknown. measured_by:
    where the value comes from. distribution: normal, rectangular or t.
    """

    name: str
    errors: tuple[str, ...]
    covariance: Float64
    measured_by: str
    distribution: str = "normal"
    degrees_of_freedom: float = inf


@dataclass(frozen=True, eq=False)
class BudgetedLoad:
    """Geometry of a bundle: centre (3,) of its top in the yard, yaw from +Y, lengths in m, mass in kg."""

    top_m: Float64
    yaw_rad: float
    length_m: float
    width_m: float
    mass_kg: float


@dataclass(frozen=True)
class BudgetedFigure:
    """A figure with its parts and combined uncertainty.

    sampled_sigma, sampled_expanded: sigma and half width of the 95.45 % interval by sampling, NaN where a
    part is unknown. agree: sampling agrees with the combined U within 5 %.
    """

    name: str
    unit: str
    parts: tuple[UncertaintyPart, ...]
    combined: CombinedUncertainty
    sampled_sigma: float
    sampled_expanded: float
    agree: bool


def measured(
    load: BudgetedLoad, view: ViewGeometry, frame_origin_m: Float64, errors: Float64,
    targets_m: Float64 | None = None,
) -> Float64:  # fmt: skip
    """Compute the measured figures of a load under errors (N, 19), in the order of `ERRORS`: FIGURES (N, 7),
    SI.

    The bundle's ends are seen from the mean position of the cameras over it, triangulated with an erroneous
    rig and moved by an erroneous yard frame about its origin; then the errors of the fit and the magnet are
    added. targets_m: (T, 3) from which the same rig found the frame, which therefore absorbs most of the
    rig's errors.
    """
    e = dict(zip(ERRORS, errors.T, strict=True))
    if targets_m is not None:
        e |= _with_frame_found(targets_m, view, frame_origin_m, e)
    direction = np.array([-np.sin(load.yaw_rad), np.cos(load.yaw_rad), 0.0])
    ends = [
        _placed(load.top_m + share * load.length_m * direction, load.top_m, view, frame_origin_m, e)
        for share in (-0.5, 0.5)
    ]
    middle, along = (ends[0] + ends[1]) / 2, ends[1] - ends[0]
    yaw = np.arctan2(-along[:, 0], along[:, 1]) + e["fit_yaw"]
    across = np.array([direction[1], -direction[0], 0.0])
    place = middle + e["fit_along"][:, None] * direction + e["fit_across"][:, None] * across
    place[:, 2] += e["fit_top"]
    scale = np.linalg.norm(along, axis=1) / load.length_m
    magnet = np.column_stack([e["magnet_x"], e["magnet_y"], e["magnet_z"]])
    # Width and length grow with the scale, the cross-section with its square.
    return np.column_stack([
        place + magnet, yaw, middle[:, 2] + e["fit_height"], load.width_m * scale + e["fit_width"],
        load.mass_kg * scale**3 + e["fit_mass"],
    ])  # fmt: skip


def _with_frame_found(
    targets: Float64, view: ViewGeometry, origin: Float64, e: dict[str, Float64]
) -> dict[str, Float64]:
    """Subtract from the frame's errors the motion that best moves targets (T, 3), as the erroneous rig sees
    them, to their true places (least squares). Returns the errors of the frame (N,) by name.
    """
    rig_alone = {name: e[name] if name in RIG else np.zeros_like(e[name]) for name in e}
    off = np.stack([_placed(one, one, view, origin, rig_alone) - one for one in targets], axis=1)
    arm = targets - origin
    design = np.concatenate([np.concatenate([-skew(one), np.eye(3)], axis=1) for one in arm])
    found = off.reshape(len(off), -1) @ np.linalg.pinv(design).T
    return {name: e[name] - found[:, k] for k, name in enumerate(FRAME)}


def _placed(
    point: Float64, over: Float64, view: ViewGeometry, origin: Float64, e: dict[str, Float64]
) -> Float64:
    """Triangulate a point (3,) with an erroneous rig from above `over`, then move it by an erroneous
    frame: (N, 3).
    """
    camera = np.array([over[0], view.camera_m[1], view.camera_m[2]])
    x, y, down = point[0] - camera[0], point[1] - camera[1], camera[2] - point[2]
    left = x / down
    # The point as the rotated right camera sees it.
    rx, rz = x - view.baseline_m, down
    right = (np.cos(e["yaw"]) * rx - np.sin(e["yaw"]) * rz) / (np.sin(e["yaw"]) * rx + np.cos(e["yaw"]) * rz)
    depth = view.baseline_m * (1 + e["baseline"]) * (1 + e["focal"]) / (left - right)
    seen = np.column_stack([
        camera[0] + left / (1 + e["focal"]) * depth, camera[1] + y / down / (1 + e["focal"]) * depth,
        camera[2] - depth,
    ])  # fmt: skip
    arm = seen - origin
    turn = np.column_stack([e["turn_x"], e["turn_y"], e["turn_z"]])
    move = np.column_stack([e["move_x"], e["move_y"], e["move_z"]])
    return np.asarray(seen + np.cross(turn, arm) + move, np.float64)


def budget(
    load: BudgetedLoad, view: ViewGeometry, frame_origin_m: Float64, sources: Sequence[ErrorSource],
    samples: int = 20_000, seed: int = 0, targets_m: Float64 | None = None,
) -> tuple[BudgetedFigure, ...]:  # fmt: skip
    """Budget every figure: parts by the model's derivatives combined by GUM, and the same by sampling.
    targets_m: as in `measured`.
    """
    scale = np.array([one[2] for one in FIGURES])
    steps = 1e-6 * np.eye(len(ERRORS))
    both = measured(load, view, frame_origin_m, np.concatenate([steps, -steps]), targets_m)
    slopes = (both[: len(ERRORS)] - both[len(ERRORS) :]) / 2e-6 * scale  # (errors, figures)
    drawn = _drawn(sources, samples, np.random.default_rng(seed))
    values = measured(load, view, frame_origin_m, drawn, targets_m) * scale
    figures = []
    for k, (name, unit, _) in enumerate(FIGURES):
        parts = tuple(part for source in sources if (part := _part(source, slopes[:, k])) is not None)
        whole = combine(parts)
        sampled = values[:, k] - np.median(values[:, k])
        half = float(np.quantile(np.abs(sampled), COVERAGE)) if np.isfinite(sampled).all() else nan
        figures.append(
            BudgetedFigure(
                name, unit, parts, whole, float(sampled.std()), half,
                bool(abs(half - whole.expanded) <= 0.05 * whole.expanded),
            )
        )  # fmt: skip
    return tuple(figures)


def _part(source: ErrorSource, slopes: Float64) -> UncertaintyPart | None:
    """Propagate one source to one figure; None where the figure does not depend on it."""
    row = slopes[[ERRORS.index(name) for name in source.errors]]
    touched = ~(np.abs(row) <= 1e-6)  # NaN: it depends on it in an unknown way
    if not touched.any():
        return None
    covariance = source.covariance[np.ix_(touched, touched)]
    variance = float(row[touched] @ covariance @ row[touched])
    sigma = float(np.sqrt(variance)) if isfinite(variance) else nan
    return UncertaintyPart(
        source.name, sigma, source.distribution, source.degrees_of_freedom, source.measured_by
    )


def _drawn(sources: Sequence[ErrorSource], samples: int, rng: np.random.Generator) -> Float64:
    """Draw errors (samples, 19) from the distribution of each source."""
    drawn = np.zeros((samples, len(ERRORS)))
    for source in sources:
        places = [ERRORS.index(name) for name in source.errors]
        known = np.isfinite(source.covariance).all(axis=1)
        if source.distribution == "rectangular":
            unit = rng.uniform(-(3**0.5), 3**0.5, (samples, len(places)))
        else:
            unit = rng.standard_normal((samples, len(places)))
            if source.distribution == "t":
                free = source.degrees_of_freedom
                unit /= np.sqrt(rng.chisquare(free, (samples, 1)) / free)
        spread, axes = np.linalg.eigh(source.covariance[np.ix_(known, known)])
        part = np.full((samples, len(places)), nan)
        part[:, known] = (unit[:, known] * np.sqrt(spread.clip(0))) @ axes.T
        drawn[:, places] += part
    return drawn
