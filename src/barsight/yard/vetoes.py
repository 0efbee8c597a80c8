"""Define all reasons not to lift: a table of codes, the checks that find them, the vetoes that state them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from barsight.yard.lift_settings import UPPER

VETOES = {
    "no-magnet": "No magnet is described; an assumed one forbids every lift.",
    "map-too-old": "The place was last seen longer ago than the settings allow, or at an unknown time.",
    "disturbed": "A lift, a set-down or a magnet came near after the map's frames of the place began.",
    "map-from-the-future": "The last frame is ahead of this computer's clock, so its age is unknown.",
    "calibration-changed": "The calibration of map or magnet's offset changed since, or has expired.",
    "magnet-turned": "The magnet's offset was found at another yaw, and turns with the magnet.",
    "calibration-drift": "The cameras' calibration no longer fits the pictures.",
    "trajectory-degraded": "The trajectory or the encoders are less accurate than the magnet needs.",
    "live-state": "The live run ended without something that lifts need.",
    "units-doubtful": "A sensor's readings have an impossible magnitude; the unit is probably wrong.",
    "mounting-doubtful": "Gravity or the floor contradicts the stated mounting of rig, IMU or encoders.",
    "stock-list": "The stock list and the measured bundle disagree.",
    "one-view": "The map was made by a single frame, so no height is confirmed by a second one.",
    "no-yard-frame": "The map isn't in the crane's yard frame, so the crane can't find the place.",
    "no-lift-area": "The magnet or the load enters an area where the settings allow no lift.",
    "no-bundle": "No known bundle is under the poles within the magnet's reach.",
    "unknown-under-footprint": "A place under or beside the magnet was neither seen nor proven free.",
    "unexplained-surface": "Something under the poles, within reach, belongs to no known bundle.",
    "bundle-doubtful": "The bundle's confidence is below the setting.",
    "covered": "Something lies or may lie on the bundle.",
    "thin-bar": "The pictures show a line across the load, or across a neighbour and towards the "
    "magnet, that may be a thin bar; or they are too coarse to show one.",
    "straddles-neighbour": "The magnet would take more bundles than are to be lifted.",
    "count-uncertain": "The number of bundles that the magnet would take is too uncertain.",
    "narrow-tolerance": "A check fails elsewhere within the crane's tolerance.",
    "obstructed": "Something stands above the plane of the faces, under or beside the magnet.",
    "tilt": "The faces slope too much along the beam, or touch too far beside their middle.",
    "gap": "A pole is too far above the steel, too little of the faces touches it, a label may hold them off "
    "too far, or the height of the steel is too uncertain.",
    "weak-pull": "The lower bound of the pull, in all or at one pole, is less than the load times the "
    "safety factor needs, or the load hangs so far beside it that it may pry the faces off.",
    "mass-unknown": "The mass can't be determined from what was seen.",
    "overweight": "The upper bound of the load's mass is more than the magnet or the crane may carry.",
    "off-centre": "The magnet's centre is too far from the load's centre of mass.",
    "overhang": "The bars reach too far beyond the outermost pole and would sag.",
    "end-open": "An end of the bundle was not seen, so its length, mass and balance are unknown.",
    "overhanging": "The bundle extends too far beyond what carries it.",
    "unstable-side": "The side of the pile leans, a neighbour may slide after this bundle, or nothing that "
    "carries it is visible.",
    "no-support": "The bundle's middle is beyond what carries it, as far as can be seen.",
    "over-stanchion": "The bundle is too high for the stanchion beside it.",
}
"""Meaning of each code; a test triggers each one."""


def _expect_veto(code: str) -> None:
    if code not in VETOES:
        raise ValueError(f"{code!r} is not a veto")


@dataclass(frozen=True)
class Veto:
    """A reason not to lift: a code of `VETOES` and a sentence with the numbers."""

    code: str
    reason: str

    def __post_init__(self) -> None:
        _expect_veto(self.code)


@dataclass(frozen=True)
class Check:
    """A check of a placement. code: of the veto that applies where it isn't passed.

    what: description of the check. value: as found, with sigma; bound: its limit; all in `unit`, None where
    there is none. result: unknown forbids a lift as failed does. reason: a sentence with the numbers, empty
    where passed.
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
    """List the vetoes: one for every check that isn't passed."""
    return tuple(Veto(check.code, check.reason) for check in checks if check.result != "passed")


def nearest_to_limit(checks: Iterable[Check]) -> Check:
    """Take, of one check made in several ways, the one that failed, else the one whose 95 % bound is nearest
    to its limit.
    """

    def margin(check: Check) -> float:
        if check.result != "passed":
            return -math.inf
        if check.value is None or check.bound is None:
            return math.inf
        return abs(check.bound - check.value) - UPPER * (check.sigma or 0.0)

    return min(checks, key=margin)


def check_max(
    code: str, what: str, value: float, bound: float, unit: str, reason: str, *, sigma: float = 0.0,
    sigmas: float = 1.0,
) -> Check:  # fmt: skip
    """Check that a value plus `sigmas` times its sigma is at most the bound."""
    return _checked(code, what, value, bound, unit, reason, sigma, sigmas, 1)


def check_min(
    code: str, what: str, value: float, bound: float, unit: str, reason: str, *, sigma: float = 0.0,
    sigmas: float = 1.0,
) -> Check:  # fmt: skip
    """Check that a value minus `sigmas` times its sigma is at least the bound."""
    return _checked(code, what, value, bound, unit, reason, sigma, sigmas, -1)


def check_true(code: str, what: str, holds: bool | None, reason: str) -> Check:
    """Check a condition that holds or doesn't; None where it isn't known."""
    result: Literal["passed", "failed", "unknown"]
    result = "unknown" if holds is None else "passed" if holds else "failed"
    return Check(code, what, None, None, None, "", result, "" if holds else reason)


def _checked(
    code: str, what: str, value: float, bound: float, unit: str, reason: str, sigma: float, sigmas: float,
    sign: int,
) -> Check:  # fmt: skip
    """Check that a value doesn't exceed its bound (sign 1) or fall below it (sign -1); NaN is unknown."""
    found, spread, limit = (float(x) if math.isfinite(x) else None for x in (value, sigma, bound))

    def check(result: Literal["passed", "failed", "unknown"], said: str) -> Check:
        return Check(code, what, found, spread, limit, unit, result, said)

    if math.isnan(value) or math.isnan(bound) or math.isnan(sigma):
        return check("unknown", reason)
    if sign * value + sigmas * sigma <= sign * bound:
        return check("passed", "")
    if sign * value <= sign * bound:
        of = f"{1.96 * sigma:.3g} {unit}".rstrip()
        reason = f"{reason}; the value is within its uncertainty of ±{of} (95 %) of the limit"
    return check("failed", reason)
