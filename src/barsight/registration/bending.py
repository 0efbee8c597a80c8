"""Model how a crane bends (girder under the trolley, rails, a girder out of square) and fit it to targets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.core.pose import skew
from barsight.registration.rigid import align_rigid, design_rows
from barsight.registration.yard import YardCalibration, calibrate_yard, predicted_covariance

BENDS = ("deflection_m", "skew_rad", "rail_m")
ORDINARY = (0.02, 0.001, 0.01)
"""Prior standard deviation of each bend of a crane that nobody has measured; used where targets don't
determine it.
"""
STEPS = (0.005, 0.0005, 0.005)
"""Step of each bend for numerical derivatives."""
UNTOLD = 0.8
"""Ratio to the prior's sigma above which the targets have hardly determined a bend."""


@dataclass(frozen=True, eq=False)
class CraneBend:
    """Bending of a crane, which no encoder measures, as a function of its encoders' readings.

    girder_y_m: the trolley's readings at the girder's ends; rails_x_m: the bridge's at the rails' ends, None
    where the rails are taken as straight. values (3,): deflection in the girder's middle under the trolley
    (m, down), skew (rad: along X for each metre along Y), sag of the rails' middle (m). covariance (9, 9): of
    the frame's turn and translation, as in `Alignment`, then of the values.
    """

    girder_y_m: tuple[float, float]
    rails_x_m: tuple[float, float] | None
    values: Float64
    covariance: Float64

    def slopes(self, place_m: Float64) -> tuple[Float64, Float64]:
        """Compute the derivatives of the shift and tilt of the crane point at positions (N, 3), (N, 3, 3)
        each, by each value.
        """
        shift, tilt = np.zeros((len(place_m), 3, 3)), np.zeros((len(place_m), 3, 3))
        sag, slope = _parabola(place_m[:, 1], self.girder_y_m)
        shift[:, 2, 0], tilt[:, 0, 0] = -sag, -slope
        shift[:, 0, 1] = place_m[:, 1] - sum(self.girder_y_m) / 2
        if self.rails_x_m is not None:
            hollow, slope = _parabola(place_m[:, 0], self.rails_x_m)
            shift[:, 2, 2], tilt[:, 1, 2] = -hollow, slope
        return shift, tilt

    def moved(self, place_m: Float64, lever_m: Float64) -> Float64:
        """Correct readings (N, 3) so that together with the lever (3,) they give the body's actual
        position.
        """
        shift, tilt = self.slopes(place_m)
        return np.asarray(place_m + shift @ self.values + np.cross(tilt @ self.values, lever_m), np.float64)

    def turn(self, place_m: Float64) -> Float64:
        """Return the mean tilt over readings (N, 3) as a rotation (3, 3) from the left; the identity
        without any.
        """
        if not len(place_m):
            return np.eye(3)
        _, tilt = self.slopes(place_m)
        turn: Float64 = Rotation.from_rotvec((tilt @ self.values).mean(axis=0)).as_matrix()
        return turn

    def with_values(self, values: Float64) -> CraneBend:
        """Replace the values."""
        return replace(self, values=values)

    @property
    def fitted(self) -> Bool:
        """Return which values are fitted (3,)."""
        return np.array([True, True, self.rails_x_m is not None])

    @property
    def sigma(self) -> Float64:
        """Return the standard deviation of each value (3,)."""
        sigma: Float64 = np.sqrt(np.diag(self.covariance)[6:])
        return sigma


def straight(girder_y_m: tuple[float, float], rails_x_m: tuple[float, float] | None) -> CraneBend:
    """Begin with a crane that doesn't bend, with the prior uncertainty of an ordinary one."""
    bend = CraneBend(girder_y_m, rails_x_m, np.zeros(3), np.zeros((9, 9)))
    covariance = np.diag([*np.zeros(6), *np.where(bend.fitted, np.square(ORDINARY), 0.0)])
    return replace(bend, covariance=covariance)


def calibrate_bent_yard(
    names: tuple[str, ...], measured: Float64, slopes: Float64, yard: Float64, covariance_m2: Float64,
    checks: Bool, frame: str, bend: CraneBend,
) -> tuple[YardCalibration, CraneBend] | Failed:  # fmt: skip
    """Estimate the frame as `calibrate_yard` does, together with the crane's bending.

    measured (N, 3): positions with `bend` as given; slopes (N, 3, 3): their derivatives by its values, in the
    same axes. `ORDINARY` is the values' prior where the targets don't determine them.
    """
    used, fitted = ~checks, bend.fitted
    prior_variance = np.where(fitted, np.square(ORDINARY), 1.0)
    values = bend.values.copy()
    for _ in range(4):
        at = measured + slopes @ (values - bend.values)
        found = align_rigid(at[used], yard[used], ("yard", frame), covariance_m2[used])
        if isinstance(found, Failed):
            return found
        turn = found.target_from_source.rotation
        design = np.concatenate([design_rows(at @ turn.T), turn @ slopes * fitted], axis=2)[used]
        weighted = np.linalg.solve(covariance_m2[used], design)
        normal = np.einsum("nki,nkj->ij", design, weighted)
        normal[6:, 6:] += np.diag(1 / prior_variance)
        wanted = np.einsum("nki,nk->i", weighted, found.residuals_m)
        wanted[6:] -= values / prior_variance * fitted
        values = values + np.linalg.solve(normal, wanted)[6:]
    at = measured + slopes @ (values - bend.values)
    rigid = calibrate_yard(names, at, yard, covariance_m2, checks, frame)
    if isinstance(rigid, Failed):
        return rigid
    # The frame's turn is about the source's origin, as in `align_rigid`.
    joint = np.linalg.inv(normal)
    joint[6:][~fitted] = joint[:, 6:][:, ~fitted] = 0.0
    return _joined(rigid, bend, values, joint, at, slopes, covariance_m2)


def _joined(
    rigid: YardCalibration, bend: CraneBend, values: Float64, joint: Float64, at: Float64, slopes: Float64,
    covariance_m2: Float64,
) -> tuple[YardCalibration, CraneBend]:  # fmt: skip
    """Replace the frame's covariance by its part of the joint one, and report the bends that the targets
    didn't determine.
    """
    alignment = replace(rigid.alignment, covariance=joint[:6, :6])
    bent = replace(bend, values=values, covariance=joint)
    turn = alignment.target_from_source.rotation
    design = np.concatenate([design_rows(at @ turn.T), turn @ slopes], axis=2)
    spread = predicted_covariance(design, joint, covariance_m2, rigid.checks)
    untold = [
        f"the targets hardly tell {name}: let bridge and trolley travel further"
        for name, one, most, is_fitted in zip(BENDS, bent.sigma, ORDINARY, bend.fitted, strict=True)
        if is_fitted and one > UNTOLD * most
    ]
    return replace(rigid, alignment=alignment, spread_m2=spread, doubts=(*rigid.doubts, *untold)), bent


def bend_carry(bend: CraneBend, turn: Float64, place_m: Float64) -> Float64:
    """Compute the derivatives of a pose's turn and position in the yard (6, 3) by the bend's values.

    turn (3, 3): yard from encoders; place_m (3,): of the crane point there, by its readings.
    """
    shift, tilt = bend.slopes(place_m[None])
    return np.vstack([turn @ tilt[0], turn @ shift[0]])


def bend_heights(bend: CraneBend, place_m: Float64, points_m: Float64) -> Float64:
    """Compute the derivatives (N, 3) of heights at points (N, 3), seen from the crane point (3,), by the
    bend's values; all in the axes of the readings.
    """
    shift, tilt = bend.slopes(place_m[None])
    rows: Float64 = shift[0, 2] + (-skew(points_m - place_m) @ tilt[0])[:, 2]
    return rows


def _parabola(at: Float64, ends_m: tuple[float, float]) -> tuple[Float64, Float64]:
    """Evaluate the parabola that is 0 at both ends and 1 in the middle (N,), and its slope per metre."""
    span = ends_m[1] - ends_m[0]
    share = (at - ends_m[0]) / span
    return 4 * share * (1 - share), 4 * (1 - 2 * share) / span
