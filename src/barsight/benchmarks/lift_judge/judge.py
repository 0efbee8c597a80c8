"""Judge a placement of the magnet on exact solids: dangerous or fine, with reasons and figures.

The magnet is set down at the target, at the corners of the tolerance box and at the centres of its sides (15
positions). Each figure is the worst of them. Beyond the first bound a lift is dangerous; it is fine only if
every figure is within its second bound; otherwise it is unclear.

| figure | dangerous | fine |
|---|---|---|
| height of foreign objects above the face plane as the load alone would carry it | > 15 mm | <= 5 mm |
| height of foreign objects above the plane at rest, within 30 mm of a face | | <= 5 mm |
| height of anything above the stated plane, under faces within tolerance | > 15 mm | <= 10 mm |
| height of anything above the beam's underside | > 0 | <= -30 mm |
| pull on another bundle over its weight; on other steel | > 5 %; > 500 N | nothing within reach + 10 mm |
| true pull over true weight, of each bundle of the load | < safety factor | >= 1.25 of it |
| a pole's pull over its share of the weight by moments | < 1 | >= 1.25 |
| load over the capacity of magnet and crane | > 1 | <= 0.9 |
| true mass over its stated upper bound | > 1.25 | <= 1 |
| stated lower bound of the pull over the true pull | > 1.25 | <= 1 |
| width, seen from above, of what lies on the load or overhangs it | > 8 mm | <= 3 mm |
| slope, worst pole's smallest gap, overhang, offset of the centre of mass, over limits | > 1.25 | <= 0.75 |
| share of the faces in contact with the load, over its limit | < 0.75 | >= 1.25 |

The load is the bundle under most of the face area. A pole's share of the weight is that of a rigid beam:
linear along it, so that forces and moments balance.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from barsight.benchmarks.lift_judge.envelopes import envelope, undersides
from barsight.benchmarks.lift_judge.faces import DrawnSurroundings, MagnetOnSolids, Standing
from barsight.benchmarks.lift_judge.lowering import Rest
from barsight.benchmarks.lift_judge.magnet import JudgedMagnet
from barsight.core.arrays import Float64
from barsight.simulation.worlds.solids import NOTHING, SolidYard

NEWTON_PER_KG = 9.81
OVER_FACES_M = (0.015, 0.005)
OVER_STATED_M = (0.015, 0.010)
OVER_BEAM_M = (0.0, -0.03)
PULLED_ALONG = 0.05
MORE, LESS = 1.25, 0.75
FULL = 0.9
COVER_M = (0.008, 0.003)
COVER_STEP_M = 0.002
TOUCHING_M = 0.003
OTHER_STEEL_N = 500.0
"""Pull, N, above which steel that belongs to no bundle counts as lifted along."""


@dataclass(frozen=True)
class Target:
    """A magnet's pose: centre; yaw of the beam from +Y; half sides of the tolerance box (m, m, rad) within
    which the lift claims to be safe. Values that the lift states, None if it states none: plane: (height,
    slope along, slope across) of the faces; upper_kg: upper bound of the load's mass; pull_low_n: lower
    bound of the pull.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    box: tuple[float, float, float]
    plane: tuple[float, float, float] | None = None
    upper_kg: float | None = None
    pull_low_n: float | None = None


@dataclass(frozen=True)
class LiftVerdict:
    """dangerous, unclear: reasons, with names and values. load: bundles that the lift is for. figures:
    worst value of each check. mass_kg: mass of the load. pull_n: pull at the target itself.
    """

    dangerous: tuple[str, ...]
    unclear: tuple[str, ...]
    load: tuple[int, ...]
    mass_kg: float
    pull_n: float
    figures: dict[str, float]

    @property
    def is_fine(self) -> bool:
        """Tell whether every figure is within its safe limit."""
        return not self.dangerous and not self.unclear


class Judge:
    """Judges placements of one magnet in one yard."""

    def __init__(self, yard: SolidYard, magnet: JudgedMagnet, wanted: int = 1) -> None:
        self._yard, self._magnet, self._wanted = yard, magnet, wanted
        self._cover: dict[tuple[int, tuple[int, ...]], float] = {}

    def judge(self, target: Target) -> LiftVerdict:
        """Judge one placement."""
        magnet = self._magnet
        yard = self._yard.seen_from(target.x_m, target.y_m, target.yaw_rad)
        slack = math.hypot(*target.box[:2]) + target.box[2] * (magnet.half_span_m + 0.3)
        around = DrawnSurroundings.around(yard, magnet, slack)
        set_down = MagnetOnSolids(magnet, around)
        load = set_down.loads(self._wanted)
        if len(load) < self._wanted:
            reason = f"{len(load)} bundles lie under the faces, {self._wanted} wanted"
            return LiftVerdict((reason,), (), load, math.nan, 0.0, {})
        offsets = _offsets(target)
        stands = [set_down.stand(load, offset) for offset in offsets]
        checks = _Checks()
        mass_kg, centre = _total(yard, load)
        self._check_stands(checks, stands, mass_kg, centre)
        self._check_load(checks, yard, load, mass_kg, centre)
        if target.plane is not None:
            plane = Rest(*target.plane, np.empty(0, np.int64))
            over = max(set_down.over_plane(plane, offset) for offset in offsets)
            checks.add("anything over the stated plane, mm", 1e3 * over, *(1e3 * b for b in OVER_STATED_M))
        pull = float(stands[0].pull.sum())
        if target.upper_kg is not None:
            checks.add("true mass over the stated bound", mass_kg / target.upper_kg, MORE, 1.0)
        if target.pull_low_n is not None:
            claimed = target.pull_low_n / max(pull, 1.0)
            checks.add("stated bound of the pull over the true pull", claimed, MORE, 1.0)
        dangerous, unclear = tuple(checks.dangerous), tuple(checks.unclear)
        return LiftVerdict(dangerous, unclear, load, mass_kg, pull, checks.figures)

    def _check_stands(self, checks: _Checks, stands: list[Standing], mass_kg: float, centre: Float64) -> None:
        magnet, weight = self._magnet, mass_kg * NEWTON_PER_KG
        over, beam = (tuple(1e3 * b for b in bounds) for bounds in (OVER_FACES_M, OVER_BEAM_M))
        checks.add("foreign over the faces, mm", 1e3 * max(s.rise_m for s in stands), *over)
        stray = 1e3 * max(s.stray_m for s in stands)
        checks.add("foreign beside the faces, mm", stray, math.inf, over[1])
        checks.add("under the beam, mm", 1e3 * max(s.beam_m for s in stands), *beam)
        for bundle in sorted({b for s in stands for b in s.spare}):
            most = max(s.others.get(bundle, 0.0) for s in stands)
            heavy = OTHER_STEEL_N if bundle == NOTHING else PULLED_ALONG * self._weight(bundle)
            name = "pull on other steel" if bundle == NOTHING else f"pull on bundle {bundle}"
            checks.add(f"{name}, N", most, heavy, -1.0)
        held = min(newton / self._weight(bundle) for s in stands for bundle, newton in s.each.items())
        checks.bound_below("pull over weight", held, magnet.factor)
        worst = min(_pole_margin(s.pull, magnet.poles[:, 0], weight, float(centre[1])) for s in stands)
        checks.bound_below("a pole's pull over its share", worst, 1.0)
        slope = max(abs(math.atan(s.rest.pitch)) for s in stands)
        checks.bound_above("slope along the beam, deg", math.degrees(slope), math.degrees(magnet.pitch_rad))
        gap = 1e3 * max(float(s.gaps.max()) for s in stands)
        checks.bound_above("a pole's least gap, mm", gap, 1e3 * magnet.gap_m)
        share = min(s.contact_share for s in stands)
        checks.add("share on the load", -share, -LESS * magnet.contact_share, -MORE * magnet.contact_share)

    def _check_load(
        self, checks: _Checks, yard: SolidYard, load: tuple[int, ...], mass_kg: float, centre: Float64
    ) -> None:
        magnet = self._magnet
        checks.add("load over what may be carried", mass_kg / magnet.carries_kg, 1.0, FULL)
        checks.bound_above("centre off along, mm", 1e3 * abs(centre[1]), 1e3 * magnet.offset_along_m)
        checks.bound_above("centre off across, mm", 1e3 * abs(centre[0]), 1e3 * magnet.offset_across_m)
        ends = [
            abs(bar.centre[1] + s * bar.half[0] * bar.axes[0, 1])
            for b in load for bar in yard.bars(b) for s in (-1, 1)
        ]  # fmt: skip
        checks.bound_above("overhang, mm", 1e3 * (max(ends) - magnet.half_span_m), 1e3 * magnet.overhang_m)
        cover = 1e3 * max(self._covered(b, load) for b in load)
        checks.add("covered over a width of, mm", cover, *(1e3 * b for b in COVER_M))

    def _weight(self, bundle: int) -> float:
        return self._yard.load(bundle)[0] * NEWTON_PER_KG

    def _covered(self, bundle: int, load: tuple[int, ...]) -> float:
        if (bundle, load) not in self._cover:
            self._cover[bundle, load] = covered_width(self._yard, bundle, load)
        return self._cover[bundle, load]


class _Checks:
    """Figures compared with their bounds."""

    def __init__(self) -> None:
        self.dangerous: list[str] = []
        self.unclear: list[str] = []
        self.figures: dict[str, float] = {}

    def add(self, name: str, value: float, dangerous_over: float, fine_to: float) -> None:
        """Compare a figure that should be small with both bounds."""
        self.figures[name] = float(value)
        text = f"{name}: {abs(value) if fine_to < 0 and value < 0 else value:.3g}"
        if value > dangerous_over:
            self.dangerous.append(f"{text} (bound {abs(dangerous_over):.3g})")
        elif not value <= fine_to:
            self.unclear.append(f"{text} (fine to {abs(fine_to):.3g})")

    def bound_above(self, name: str, value: float, limit: float) -> None:
        """Compare a figure with one of the magnet's limits, with a margin of a quarter on either side."""
        self.add(name, value, MORE * limit, LESS * limit)

    def bound_below(self, name: str, value: float, limit: float) -> None:
        """Compare a figure that should be large: dangerous below the limit, fine from 1.25 of it."""
        self.add(name, -value, -limit, -MORE * limit)
        self.figures[name] = float(value)


def _offsets(target: Target) -> list[tuple[float, float, float]]:
    """List the target, the box's corners and the centres of its sides as (across, along, turn)."""
    c, s = math.cos(target.yaw_rad), math.sin(target.yaw_rad)
    signs = [(0, 0, 0), *itertools.product((-1, 1), repeat=3)]
    signs += [(0,) * k + (sign,) + (0,) * (2 - k) for k in range(3) for sign in (-1, 1)]
    moved = []
    for i, j, k in signs:
        dx, dy = i * target.box[0], j * target.box[1]
        moved.append((c * dx + s * dy, -s * dx + c * dy, k * target.box[2]))
    return list(dict.fromkeys(moved))


def _total(yard: SolidYard, load: tuple[int, ...]) -> tuple[float, Float64]:
    parts = [yard.load(bundle) for bundle in load]
    mass = sum(kg for kg, _ in parts)
    return mass, np.sum([kg * centre for kg, centre in parts], axis=0) / mass


def _pole_margin(pull: Float64, along: Float64, weight: float, centre_along: float) -> float:
    """Compute the smallest ratio of pull to weight share over the poles.

    The share is linear along the beam, so that forces and moments balance.
    """
    away = along - along.mean()
    spread = float(away @ away)
    turn = away * (centre_along - along.mean()) / spread if spread > 0 else 0.0 * away
    share = weight * (1 / len(along) + turn)
    return float((pull[share > 0] / share[share > 0]).min())


def covered_width(yard: SolidYard, bundle: int, load: tuple[int, ...]) -> float:
    """Measure the width, seen from above, of anything that lies on a bundle or overhangs it, m.

    Counts other solids whose underside is above the bundle's top at the same place (or within TOUCHING_M of
    it). The result is the shorter side of the largest patch, with a resolution of COVER_STEP_M.
    """
    bars = yard.bars(bundle)
    longest = max(bars, key=lambda bar: float(bar.half[0]))
    yaw = math.atan2(-longest.axes[0, 0], longest.axes[0, 1])
    local = yard.seen_from(float(longest.centre[0]), float(longest.centre[1]), yaw)
    own = [s.bounds for s in local.solids if s.bundle == bundle]
    low, high = np.min([b[0] for b in own], axis=0), np.max([b[1] for b in own], axis=0)
    widest = 0.0
    for number, solid in enumerate(local.solids):
        bounds = solid.bounds
        a, b = np.maximum(low, bounds[0])[:2], np.minimum(high, bounds[1])[:2]
        if solid.bundle in load or (b - a).min() < COVER_M[1] or bounds[1, 2] < low[2]:
            continue
        corners = (float(a[0]), float(a[1])), (float(b[0]), float(b[1]))
        take = np.isin(local.owner, bundle).astype(float)
        tops = envelope(local, *corners, take=take, step=COVER_STEP_M)
        under = undersides(local, *corners, number=number, step=COVER_STEP_M)
        over = (tops.top != NOTHING) & np.isfinite(under) & (under > tops.z - TOUCHING_M)
        inside = np.pad(over, 1)
        # The largest depth inside a patch k cells wide is (k + 1) / 2 cells.
        deepest = float(ndimage.distance_transform_cdt(inside, metric="chessboard").max())
        widest = max(widest, max(2 * deepest - 1, 0.0) * COVER_STEP_M)
    return widest
