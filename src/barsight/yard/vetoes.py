"""Define all reasons not to lift: one table of codes, the checks that find them, the vetoes that say them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

VETOES = {
    "no-magnet": "No magnet was described: what is only assumed forbids every lift.",
    "map-too-old": "The place was last seen longer ago than the settings allow, or nobody knows when.",
    "disturbed": "A lift, a set-down or a magnet came near after the place was last seen.",
    "map-from-the-future": "The last frame is ahead of this computer's clock: ages can't be told.",
    "calibration-changed": "The calibration changed since map or magnet's offset, or isn't valid any more.",
    "calibration-drift": "The cameras' calibration doesn't fit the pictures any more.",
    "trajectory-degraded": "Trajectory or encoders aren't as sure as the magnet needs, near it or at all.",
    "live-state": "The live run ended without a sensor that lifts need.",
    "units-doubtful": "A sensor's numbers are of a size that can't be: a wrong unit.",
    "mounting-doubtful": "Gravity or the floor contradict how rig, IMU and encoders are said to be mounted.",
    "stock-list": "The stock list says another bundle than the one that was found.",
    "one-view": "One frame made the map: no height is confirmed by another.",
    "no-yard-frame": "The map isn't in the crane's yard frame, so the crane can't go there.",
    "no-lift-area": "The magnet or the load reaches into a place where the settings allow no lift.",
    "no-bundle": "No bundle lies under the footprint within the magnet's reach.",
    "unknown-under-footprint": "Under or beside the magnet a place is neither seen nor proven free by sight.",
    "unexplained-surface": "Something under the poles, within reach, belongs to no known bundle.",
    "bundle-doubtful": "The bundle is less sure than the settings ask.",
    "covered": "Something lies on the bundle, or whether something does isn't known.",
    "thin-bar": "The pictures show a line across the load, or a line or an edge across a neighbour that may "
    "reach under the magnet, or can't show one.",
    "straddles-neighbour": "The footprint reaches over more bundles than are to be lifted.",
    "count-uncertain": "How many bundles the magnet would take isn't sure enough.",
    "narrow-tolerance": "Within the crane's own tolerance the lift would not stay as checked.",
    "obstructed": "Something stands above the faces' plane under the magnet or beside it.",
    "tilt": "The faces don't lie: they slope too much, or rest beside their middle and tip.",
    "gap": "A pole hangs above the steel, too little of the faces lies on it, or a label holds one off.",
    "weak-pull": "The lower bound of the pull is less than the load's weight times the safety factor.",
    "mass-unknown": "The mass can't be told from what was seen.",
    "overweight": "The load's upper bound is more than the magnet or the crane may carry.",
    "off-centre": "The magnet's centre is too far from the load's centre of mass.",
    "overhang": "The bars reach too far beyond the outermost pole and would sag.",
    "end-open": "An end of the bundle was not seen: length, mass and balance are not known.",
    "overhanging": "The bundle lies over the edge of what carries it.",
    "unstable-side": "A neighbour may follow this bundle, or what carries it shows on neither side.",
    "no-support": "What should carry the bundle isn't there, as far as can be seen.",
    "over-stanchion": "The bundle stands higher than the stanchions allow.",
}
"""Code to what it means; a test trips each."""


def _expect_veto(code: str) -> None:
    if code not in VETOES:
        raise ValueError(f"{code!r} is no veto")


@dataclass(frozen=True)
class Veto:
    """Reason not to lift: a code of `VETOES` and a sentence with the figures."""

    code: str
    reason: str

    def __post_init__(self) -> None:
        _expect_veto(self.code)


@dataclass(frozen=True)
class Check:
    """A check of a placement. code: the veto that it is where it isn't passed.

    what: is checked, in words. value: what was found, with sigma, bound: what it is held against, all in
    `unit`; None where there is none. result: unknown forbids as failed does. reason: a sentence with the
    figures, empty where passed.
    """

    code: str
    what: str
    value: float | None
    sigma: float | None
    bound: float | None
    unit: str
    result: Literal["passed", "failed", "unknown"]
    reason: str

    def __post_init__(self) -> None:
        _expect_veto(self.code)


def vetoes_of(checks: Iterable[Check]) -> tuple[Veto, ...]:
    """Derive the vetoes: every check that isn't passed."""
    return tuple(Veto(check.code, check.reason) for check in checks if check.result != "passed")


def check_max(
    code: str, what: str, value: float, bound: float, unit: str, reason: str, *, sigma: float = 0.0,
    sigmas: float = 1.0,
) -> Check:  # fmt: skip
    """Check that a value and `sigmas` times its sigma above it are within an upper bound."""
    return _checked(code, what, value, bound, unit, reason, sigma, sigmas, 1)


def check_min(
    code: str, what: str, value: float, bound: float, unit: str, reason: str, *, sigma: float = 0.0,
    sigmas: float = 1.0,
) -> Check:  # fmt: skip
    """Check that a value and `sigmas` times its sigma below it are within a lower bound."""
    return _checked(code, what, value, bound, unit, reason, sigma, sigmas, -1)


def check_true(code: str, what: str, holds: bool | None, reason: str) -> Check:
    """Check what is so or not; None where nobody knows."""
    result: Literal["passed", "failed", "unknown"]
    result = "unknown" if holds is None else "passed" if holds else "failed"
    return Check(code, what, None, None, None, "", result, "" if holds else reason)


def _checked(
    code: str, what: str, value: float, bound: float, unit: str, reason: str, sigma: float, sigmas: float,
    sign: int,
) -> Check:  # fmt: skip
    """Judge a value, which may not be over its bound, with the sign -1 not under it; a NaN is unknown."""
    found, spread, limit = (float(x) if math.isfinite(x) else None for x in (value, sigma, bound))

    def check(result: Literal["passed", "failed", "unknown"], said: str) -> Check:
        return Check(code, what, found, spread, limit, unit, result, said)

    if math.isnan(value) or math.isnan(bound) or math.isnan(sigma):
        return check("unknown", reason)
    if sign * value + sigmas * sigma <= sign * bound:
        return check("passed", "")
    if sign * value <= sign * bound:
        of = f"{1.96 * sigma:.3g} {unit}".rstrip()
        reason = f"{reason}, but the figure is known to ±{of} (95 %) only"
    return check("failed", reason)
