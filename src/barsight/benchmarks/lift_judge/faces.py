"""Set the magnet down at one position on the exact solids: find contacts, pull and obstructions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from barsight.benchmarks.lift_judge.envelopes import STEP_M, Envelope, envelope
from barsight.benchmarks.lift_judge.lowering import Rest, lower
from barsight.benchmarks.lift_judge.magnet import JudgedMagnet
from barsight.core.arrays import Float32, Float64, Int32, Int64, kernel
from barsight.simulation.worlds.solids import NOTHING, SolidYard

STRAY_M = 0.03
"""Margin, m, around the faces to be free above their plane, for the stray field and the pole bodies."""
CONTACT_GAP_M = 0.003
"""Largest gap, m, between a point of a face and the load's steel at which the point counts as in contact."""
NEAR_M = 0.15
"""Largest depth, m, of steel below the resting faces at which its bundle can still be the intended load."""
SPARE_REACH_M = 0.01


@dataclass(frozen=True, eq=False)
class DrawnSurroundings:
    """Solids near a magnet in the magnet's frame (X across, Y along the beam), rasterised at 1 mm wherever
    its faces may come and at 5 mm under the beam. owner: bundle of each solid.
    """

    yard: SolidYard
    owner: Int32
    all: Envelope
    steel: Envelope
    coarse: Envelope

    @classmethod
    def around(cls, yard: SolidYard, magnet: JudgedMagnet, slack_m: float) -> DrawnSurroundings:
        """Rasterise the solids around the origin. slack_m: largest displacement of a magnet's point, m."""
        poles = magnet.poles
        across = float((np.abs(poles[:, 1]) + poles[:, 3] / 2).max()) + STRAY_M + slack_m + 0.01
        along = magnet.half_span_m + STRAY_M + slack_m + 0.01
        # Puts cell centres at the sample points of faces whose size is whole millimetres.
        across, along = (math.ceil(half / STEP_M) * STEP_M + STEP_M / 2 for half in (across, along))
        wide, long = max(magnet.beam[1] / 2 + slack_m, across), max(magnet.beam[0] / 2 + slack_m, along)
        near = SolidYard(
            tuple(
                s for s in yard.solids
                if (s.bounds[0, :2] < (wide, long)).all() and (s.bounds[1, :2] > (-wide, -long)).all()
            )
        )  # fmt: skip
        corners = (-across, -along), (across, along)
        steel = np.array([s.is_steel for s in near.solids])
        every = envelope(near, *corners)
        return cls(
            near, near.owner, every,
            every if steel.all() else envelope(near, *corners, take=steel.astype(float)),
            envelope(near, (-wide, -long), (wide, long), step=5 * STEP_M),
        )  # fmt: skip

    def own(self, load: tuple[int, ...]) -> Envelope:
        """Rasterise the load alone."""
        low = self.all.x0, self.all.y0
        return envelope(self.yard, low, (-low[0], -low[1]), take=np.isin(self.owner, load).astype(float))


@dataclass(frozen=True, eq=False)
class Spread:
    """Sample points on rectangles of the magnet, before it is moved: u across, v along (N,), m. pole:
    number of each point's rectangle. cell: number of the eighth of a rectangle that holds it.
    """

    u: Float64
    v: Float64
    pole: Int64
    cell: Int64

    @classmethod
    def over(cls, rectangles: Float64, margin: float, step: float) -> Spread:
        """Sample rectangles (P, 4), each along, across, length, width, enlarged by `margin` on every side."""
        parts = []
        for number, (along, across, length, width) in enumerate(rectangles):
            v = _middles(along, length / 2 + margin, step)
            u = _middles(across, width / 2 + margin, step)
            vv, uu = (a.ravel() for a in np.meshgrid(v, u))
            quarter = np.minimum((4 * ((vv - along) / (length + 2 * margin) + 0.5)).astype(np.int64), 3)
            cell = 8 * number + 2 * quarter + (uu > across)
            parts.append((uu, vv, np.full(len(uu), number), cell))
        u, v, pole, cell = (np.concatenate(column) for column in zip(*parts, strict=True))
        return cls(u, v, pole, cell)

    def look(
        self, drawn: Envelope, owner: Int32, offset: tuple[float, float, float]
    ) -> tuple[Float64, Int32]:
        """Look up height, m, and bundle under the points after a displacement (across, along, turn); the
        height is -inf and the bundle NOTHING over the bare floor.
        """
        z, found = np.empty(len(self.u)), np.empty(len(self.u), np.int32)
        grid = np.array([drawn.x0, drawn.y0, drawn.step])
        _look(self.u, self.v, np.array(offset), grid, drawn.z, drawn.top, owner, z, found)
        return z, found


@kernel()
def _look(
    u: Float64, v: Float64, offset: Float64, grid: Float64, drawn: Float32, top: Int32, owner: Int32,
    z: Float64, found: Int32,
) -> None:  # fmt: skip
    """Look up the nearest cells of points u, v (N,), displaced by `offset`: across, along, turn.

    grid: x0, y0 and step of drawn, top: (X, Y) of an `Envelope`; owner: (S,) bundle of each solid. Fills z
    (N,), m, and found (N,), the bundle.
    """
    across, along, turn = offset
    x0, y0, step = grid
    c, s = math.cos(turn), math.sin(turn)
    for k in range(len(u)):
        i = math.floor((across + c * u[k] - s * v[k] - x0) / step + 0.5)
        j = math.floor((along + s * u[k] + c * v[k] - y0) / step + 0.5)
        i, j = min(max(i, 0), drawn.shape[0] - 1), min(max(j, 0), drawn.shape[1] - 1)
        z[k], found[k] = -np.inf, NOTHING
        if top[i, j] != NOTHING:
            z[k], found[k] = drawn[i, j], owner[top[i, j]]


def _middles(centre: float, half: float, step: float) -> Float64:
    count = max(round(2 * half / step), 1)
    return np.asarray(centre - half + (np.arange(count) + 0.5) * 2 * half / count, np.float64)


@dataclass(frozen=True, eq=False)
class Standing:
    """The magnet at rest in one position.

    rise_m: largest height of anything but the load above the face plane, with the faces carried by the load
    alone; stray_m: the same within STRAY_M of the faces, above the plane at rest. beam_m: largest height of
    anything above the beam's underside. pull: (P,) pull on the load, N; each: pull on each bundle of it, N;
    others: pull on each other bundle, N, and on other steel under the key NOTHING. spare: bundles within the
    magnet's reach plus SPARE_REACH_M. gaps: (P,) smallest gap to the load's steel, m. contact_share: share of
    the faces in contact with the load.
    """

    rest: Rest
    rise_m: float
    stray_m: float
    beam_m: float
    pull: Float64
    each: dict[int, float]
    others: dict[int, float]
    spare: tuple[int, ...]
    gaps: Float64
    contact_share: float


class MagnetOnSolids:
    """Sets one magnet down at positions around the origin of its surroundings."""

    def __init__(self, magnet: JudgedMagnet, around: DrawnSurroundings) -> None:
        self._magnet, self._around = magnet, around
        beam = np.array([[0.0, 0.0, magnet.beam[0], magnet.beam[1]]])
        self._faces = Spread.over(magnet.poles, 0.0, STEP_M)
        self._stray = Spread.over(magnet.poles, STRAY_M, 3 * STEP_M)
        self._beam = Spread.over(beam, 0.0, 5 * STEP_M)
        self._own: dict[tuple[int, ...], Envelope] = {}

    def rest(self, z: Float64) -> Rest:
        """Lower the faces onto the heights z (N,), m, under their points."""
        faces = self._faces
        return lower(faces.v, faces.u, z, faces.cell, math.tan(self._magnet.roll_rad))

    def loads(self, count: int) -> tuple[int, ...]:
        """Find the intended load: the `count` bundles under the largest area of the faces."""
        around, here = self._around, (0.0, 0.0, 0.0)
        z, _ = self._faces.look(around.all, around.owner, here)
        if not np.isfinite(z).any():
            return ()
        steel, owner = self._faces.look(around.steel, around.owner, here)
        plane = self.rest(z).at(self._faces.v, self._faces.u)
        under = owner[(steel > plane - NEAR_M) & (owner != NOTHING)]
        bundles, points = np.unique(under, return_counts=True)
        return tuple(int(b) for b in bundles[np.argsort(-points, kind="stable")][:count])

    def stand(self, load: tuple[int, ...], offset: tuple[float, float, float]) -> Standing:
        """Set the magnet down at an offset (across, along, turn) from the origin."""
        faces, around = self._faces, self._around
        z, owner = faces.look(around.all, around.owner, offset)
        foreign = ~np.isin(owner, load)
        rest = self.rest(z)
        rise = float((z - rest.at(faces.v, faces.u))[foreign].max(initial=-np.inf))
        if foreign[rest.contacts].any():
            if load not in self._own:
                self._own[load] = around.own(load)
            own, _ = faces.look(self._own[load], around.owner, offset)
            # If none of the load is below the faces, only foreign objects carry them.
            rise = math.inf
            if np.isfinite(own).any():
                rise = float((z - self.rest(own).at(faces.v, faces.u))[foreign].max())
        return Standing(
            rest, rise, self._above(self._stray, around.all, rest, offset, load),
            self._above(self._beam, around.coarse, rest, offset, ()) - self._magnet.beam[2],
            *self._pulls(load, rest, offset),
        )  # fmt: skip

    def over_plane(self, plane: Rest, offset: tuple[float, float, float]) -> float:
        """Compute the largest height above a plane in the magnet's frame, m, under displaced faces."""
        faces = self._faces
        z, _ = faces.look(self._around.all, self._around.owner, offset)
        c, s = math.cos(offset[2]), math.sin(offset[2])
        v, u = offset[1] + s * faces.u + c * faces.v, offset[0] + c * faces.u - s * faces.v
        return float((z - plane.at(v, u)).max())

    def _above(
        self, spread: Spread, drawn: Envelope, rest: Rest, offset: tuple[float, float, float],
        load: tuple[int, ...],
    ) -> float:  # fmt: skip
        z, owner = spread.look(drawn, self._around.owner, offset)
        foreign = ~np.isin(owner, load)
        return float((z - rest.at(spread.v, spread.u))[foreign].max(initial=-np.inf))

    def _pulls(
        self, load: tuple[int, ...], rest: Rest, offset: tuple[float, float, float]
    ) -> tuple[Float64, dict[int, float], dict[int, float], tuple[int, ...], Float64, float]:
        """Integrate the pull over the faces at 1 mm, split by pole and by the bundle it acts on.

        On the load the pull is limited by the thickness of its bars, on all else it is that of a thick plate.
        """
        faces, magnet, around = self._faces, self._magnet, self._around
        z, owner = faces.look(around.steel, around.owner, offset)
        gap = rest.at(faces.v, faces.u) - z
        poles = len(magnet.poles)
        area = magnet.poles[:, 2] * magnet.poles[:, 3] / np.bincount(faces.pole, minlength=poles)
        is_load = np.isin(owner, load)
        pull = np.zeros((len(load), poles))
        for k, bundle in enumerate(load):
            diameter = min(2 * float(bar.half[1]) for bar in around.yard.bars(bundle))
            for p, face in enumerate(magnet.poles[:, 2:].min(axis=1)):
                of = gap[(owner == bundle) & (faces.pole == p)]
                pull[k, p] = area[p] * magnet.bar_pressure(of, diameter, float(face)).sum()
        each = dict(zip(load, pull.sum(axis=1).tolist(), strict=True))
        others, spare = dict[int, float](), list[int]()
        beside = ~is_load & (gap < magnet.reach_m + SPARE_REACH_M)
        for bundle in np.unique(owner[beside]).tolist():
            of = beside & (owner == bundle)
            spare.append(bundle)
            others[bundle] = float((magnet.pressure(gap[of]) * area[faces.pole[of]]).sum())
        gaps = np.array([gap[is_load & (faces.pole == p)].min(initial=np.inf) for p in range(poles)])
        share = float((is_load & (gap <= CONTACT_GAP_M)).mean())
        return pull.sum(axis=0), each, others, tuple(spare), gaps, share
