"""Which bundles lie under a magnet's poles, as an integer with its probability.

Poles and bundles are rectangles seen from above; two overlap where no side of either separates them. Each
overlap has a depth, the depth a sigma (of the bundle's place, yaw, width and ends) and a bound on how much the
crane's tolerance can change it: the count is as sure as all depths together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from barsight.core.arrays import Bool, Float64
from barsight.yard.magnet import Magnet, Tolerance
from barsight.yard.types import Bundle

BEYOND_OPEN_END_M = 20.0
LEAST_SIGMA_M = 0.001
HEIGHT_SIGMA_M = 0.005
"""How well a bundle's top line stands for its height under a pole, beside its own sigma."""


@dataclass(frozen=True)
class Placement:
    """Where the magnet's centre is set down: yard axes; yaw from +Y about Z, as a bundle's."""

    x_m: float
    y_m: float
    yaw_rad: float

    @property
    def along(self) -> Float64:
        """(2,) unit vector along the beam."""
        return np.array([-np.sin(self.yaw_rad), np.cos(self.yaw_rad)])

    @property
    def across(self) -> Float64:
        """(2,) unit vector across the beam."""
        return np.array([np.cos(self.yaw_rad), np.sin(self.yaw_rad)])


@dataclass(frozen=True, eq=False)
class BundleTable:
    """Bundles as arrays, for all at once. Lengths in m.

    centre: (B, 2). along: (B, 2) unit. half: (B, 2) half width, half length. top: (B,) at mid-length, slope:
    (B,) rise per metre along. sigma: (B, 5) of lateral, along, yaw, half width, half length; NaN is taken as
    `unknown_sigma`. sigma_top: (B,). open_ends: (B, 2) low-y and high-y end.
    """

    bundles: tuple[Bundle, ...]
    centre: Float64
    along: Float64
    half: Float64
    top: Float64
    slope: Float64
    sigma: Float64
    sigma_top: Float64
    open_ends: Bool

    @classmethod
    def of(cls, bundles: tuple[Bundle, ...]) -> BundleTable:
        """A sigma that is unknown counts as 50 mm, 5 mrad: sure enough of nothing."""
        yaw = np.array([b.yaw_rad for b in bundles])
        sigma = np.array(
            [
                (b.sigma.lateral_m, b.sigma.along_m, b.sigma.yaw_rad, b.sigma.width_m / 2, b.sigma.length_m / 2)
                for b in bundles
            ]
        ).reshape(-1, 5)
        unknown = np.broadcast_to((0.05, 0.05, 0.005, 0.05, 0.05), sigma.shape)
        sigma_top = np.array([b.sigma.top_z_m for b in bundles])
        return cls(
            bundles,
            np.array([b.centre_m[:2] for b in bundles]).reshape(-1, 2),
            np.stack([-np.sin(yaw), np.cos(yaw)], axis=1).reshape(-1, 2),
            np.array([(b.width_m / 2, b.length_m / 2) for b in bundles]).reshape(-1, 2),
            np.array([b.top_z_m for b in bundles]),
            np.tan([b.pitch_rad for b in bundles]),
            np.where(np.isfinite(sigma), sigma, unknown),
            np.where(np.isfinite(sigma_top), sigma_top, 0.05),
            np.array([b.ends_open for b in bundles], dtype=np.bool_).reshape(-1, 2),
        )


@dataclass(frozen=True, eq=False)
class Grip:
    """What the magnet would take at a placement.

    gripped: positions in the table of the bundles under a pole and within reach. probability: of exactly
    these. flips: (B,) probability for each bundle that it is wrongly counted in or out.
    """

    gripped: tuple[int, ...]
    probability: float
    flips: Float64


def grip(
    place: Placement, magnet: Magnet, tolerance: Tolerance, table: BundleTable, face_z_m: Float64
) -> Grip:
    """Count the bundles under the poles whose top lies within the magnet's reach.

    face_z_m: (P,) height of each pole's face. tolerance: how far off the crane may set down; a hard bound.
    """
    poles = magnet.pole_table
    count = len(table.bundles)
    if count == 0:
        return Grip((), 1.0, np.empty(0))
    centre = np.array([place.x_m, place.y_m]) + poles[:, :1] * place.along + poles[:, 1:2] * place.across
    half = poles[:, [3, 2]] / 2
    seen, sigma, slack = _depth(place, centre, half, table, table.centre, table.half, tolerance, poles)
    miss = ndtr(-np.maximum(np.abs(seen) - slack, 0) / sigma)
    # Where a bundle's open end may lie under the pole, nobody knows.
    shift = (table.open_ends[:, 1].astype(float) - table.open_ends[:, 0]) * BEYOND_OPEN_END_M / 2
    longer = table.half + np.stack([np.zeros(count), table.open_ends.sum(axis=1) * BEYOND_OPEN_END_M / 2], 1)
    further = table.centre + shift[:, None] * table.along
    most, _, _ = _depth(place, centre, half, table, further, longer, tolerance, poles)
    miss[(most > 0) & (seen <= 0)] = 0.5

    away = np.einsum("pbi,bi->pb", centre[:, None] - table.centre, table.along)
    over = table.top + away * table.slope - (face_z_m[:, None] - magnet.reach_m)
    low = ndtr(-np.abs(over) / np.hypot(table.sigma_top, HEIGHT_SIGMA_M))
    under = np.where(seen > 0, 1 - miss, miss) * np.where(over > 0, 1 - low, low)
    taken = (seen > 0) & (over > 0)
    gripped = taken.any(axis=0)
    kept = np.where(taken, 1 - under, 1.0).min(axis=0)
    added = np.minimum(under.sum(axis=0), 1.0)
    flips = np.where(gripped, kept, added)
    return Grip(tuple(np.flatnonzero(gripped).tolist()), float(np.prod(1 - flips)), flips)


def _depth(
    place: Placement, pole_centre: Float64, pole_half: Float64, table: BundleTable, centre: Float64,
    half: Float64, tolerance: Tolerance, poles: Float64,
) -> tuple[Float64, Float64, Float64]:  # fmt: skip
    """(P, B) overlap depth (negative is a distance), its sigma and the crane's slack, along the axis that counts."""
    between = pole_centre[:, None] - centre[None]
    sideways = np.stack([table.along[:, 1], -table.along[:, 0]], axis=1)
    lateral_yaw = np.abs(np.einsum("pbi,bi->pb", between, table.along)) * table.sigma[:, 2]
    yaw = np.radians(tolerance.yaw_deg)
    lever = np.abs(poles[:, 0]) + poles[:, 2] / 2, np.abs(poles[:, 1]) + poles[:, 3] / 2
    best: tuple[Float64, Float64, Float64] | None = None
    shape = between.shape[:2]
    own = (np.broadcast_to(place.across, (shape[1], 2)), np.broadcast_to(place.along, (shape[1], 2)))
    for normal in (sideways, table.along, *own):
        reach_b = np.abs((normal * sideways).sum(1)) * half[:, 0] + np.abs((normal * table.along).sum(1)) * half[:, 1]
        n_across, n_along = np.abs(normal @ place.across), np.abs(normal @ place.along)
        reach_p = n_across[None] * pole_half[:, :1] + n_along[None] * pole_half[:, 1:]
        depth = reach_b[None] + reach_p - np.abs(np.einsum("pbi,bi->pb", between, normal))
        side, end = (normal * sideways).sum(1) ** 2, (normal * table.along).sum(1) ** 2
        s = table.sigma
        variance = side * (s[:, 0] ** 2 + lateral_yaw**2 + s[:, 3] ** 2) + end * (s[:, 1] ** 2 + s[:, 4] ** 2)
        slack = tolerance.x_m * np.abs(normal[:, 0]) + tolerance.y_m * np.abs(normal[:, 1])
        slack = slack[None] + yaw * (lever[0][:, None] * n_across[None] + lever[1][:, None] * n_along[None])
        found = depth, np.sqrt(variance + LEAST_SIGMA_M**2), slack
        if best is None:
            best = found
        else:
            nearer = found[0] < best[0]
            best = tuple(np.where(nearer, new, old) for new, old in zip(found, best, strict=True))  # type: ignore[assignment]
    assert best is not None
    return best
