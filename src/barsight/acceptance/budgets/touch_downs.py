"""Average the touch-downs of a certificate into the offset of the magnet from where the crane places it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from barsight.acceptance.certificate import REMEDY as OTHER
from barsight.acceptance.certificate import read_certificate
from barsight.acceptance.uncertainty import COVERAGE
from barsight.artefacts.plan import TouchDown
from barsight.core.arrays import Float64
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import in_range
from barsight.motion.rig_check.drift_check import BAD_STATES
from barsight.registration.agreement import DOUBTFUL
from barsight.yard.axes import axes_of
from barsight.yard.magnet.description import MAX_OFFSET_M, MagnetOffset, Tolerance

MIN_ARTEFACTS = 3
"""Minimum number of artefacts that are touched: each is seen with an error that all its touch-downs share."""
MIN_SPAN_RATIO = 0.5
"""Minimum ratio, along X and Y, of the span of the touched artefacts to that of all: beyond it a yard frame
that is turned against the crane's axes makes another offset.
"""
MAX_APART_M = 0.1
"""Maximum spread (m) along one axis of touch-downs made by one magnet at rest."""
MIN_TURN_DEG = 30.0
"""Minimum angle (degrees) between touch-downs that tell which part of the offset turns with the magnet."""
MIN_PARTED, DRAWS = 10.0, 20_000
"""Ratio up to which two groups are parted by chance, however many touch-downs there are, and number of drawn
samples by which the chance of a larger one is found.
"""


def touched_offset(certificate: Path, tolerance: Tolerance) -> MagnetOffset:
    """Average the touch-downs of a certificate into the magnet's offset from where the crane's readings place
    it.

    The mean is that of the artefacts' means. Its sigma is the largest of the artefacts' scatter and the
    scatter of all, each over the root of its number, and of what the sigma of a reading leaves, widened so
    that two sigma cover 95.45 % by Student's t. Where the magnet was turned, the part of the offset that
    turns is fitted first, and subtracted. Raises InputError where the certificate is unsuitable, or the crane
    doesn't keep the magnet's tolerance.
    """
    content, touches = read_certificate(certificate), touch_errors_m(certificate)
    try:
        _expect_sound(certificate, content)
        rows = [row for row in content["quantities"] if row["group"] == "touch_mm"]
        own_m = 1e-3 * max((float(row["uncertainty"]["sigma"]) for row in rows), default=0.0)
        ids = str(content["calibration_id"]), str(content["yard_frame_id"])
        downs = {str(one["name"]): TouchDown(**one) for one in content["plan"]["touch_down"]}
        touched = {name: one.on for name, one in downs.items()}
        yaws_rad = {name: math.radians(one.yaw_deg) for name, one in downs.items()}
        digests = tuple(one.digest for one in downs.values())
        _expect_spread(certificate, content["plan"], set(touched.values()))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(certificate, f"is damaged ({type(error).__name__}: {error})", OTHER) from error
    turning = _turning_part(certificate, touches, touched, yaws_rad, own_m)
    if turning is not None:
        touches = _without(turning, touches, yaws_rad)
    errors_m = [_mean_touch_m(certificate, axis, touches.get(axis, {}), touched, own_m) for axis in "xyz"]
    _expect_kept(certificate, touches, tolerance)
    (x, x_sigma), (y, y_sigma), (z, z_sigma) = errors_m
    max_m = max(map(abs, (x, y, z, *((turning.along_m, turning.across_m) if turning else ()))))
    if max_m > MAX_OFFSET_M:
        problem = f"the magnet hangs {1e3 * max_m:.0f} mm off: that is the rig's lever arm"
        raise InputError(certificate, problem, "correct p_crane_body in crane0/sensor.yaml and accept again")
    middle = complex(np.mean([np.exp(1j * yaws_rad[name]) for name in touches["x"]]))
    if turning is None:
        yaw_deg = float(np.degrees(np.angle(middle)))
        return MagnetOffset(x, y, z, x_sigma, y_sigma, z_sigma, *ids, yaw_deg, touch_downs=digests)
    shared = abs(middle) * turning.sigma_m  # what an error of the part that turns adds to the means
    sigmas = (math.hypot(x_sigma, shared), math.hypot(y_sigma, shared), z_sigma)
    turns = (0.0, turning.along_m, turning.across_m, turning.sigma_m)
    return MagnetOffset(x, y, z, *sigmas, *ids, *turns, digests)


@dataclass(frozen=True)
class _Turning:
    """The part of an offset that turns with the magnet, in the beam's axes, with the sigma of each."""

    along_m: float
    across_m: float
    sigma_m: float


def _turning_part(
    certificate: Path, errors_m: Mapping[str, Mapping[str, float]], touched: Mapping[str, str],
    yaws_rad: Mapping[str, float], own_m: float,
) -> _Turning | None:  # fmt: skip
    """Fit the part of the offset that turns with the magnet; None where the magnet was hardly turned.

    Its sigma is the larger of what leaving out one artefact after another shows, widened as the mean's, and
    of what the sigma of a reading leaves. Raises InputError where it was turned on one artefact only.
    """
    names = sorted(errors_m.get("x", {}).keys() & errors_m.get("y", {}).keys())
    if _span_deg([yaws_rad[name] for name in names]) < MIN_TURN_DEG:
        return None

    def fit(chosen: Sequence[str]) -> tuple[Float64, float]:
        """Solve for across and along, and x and y; also return the former's sigma per unit of error."""
        rows = np.concatenate([np.hstack([axes_of(yaws_rad[name]).T, np.eye(2)]) for name in chosen])
        told = np.array([errors_m[axis][name] for name in chosen for axis in "xy"])
        inverse = np.linalg.inv(rows.T @ rows)
        return (inverse @ rows.T @ told)[:2], float(inverse[0, 0]) ** 0.5

    artefacts = sorted({touched[name] for name in names})
    left = [[name for name in names if touched[name] != one] for one in artefacts]
    if any(_span_deg([yaws_rad[name] for name in rest]) < MIN_TURN_DEG for rest in left):
        problem = "has touch-downs with the magnet turned on one artefact only"
        raise InputError(certificate, problem, "touch several artefacts at each yaw")
    (across, along), per_error = fit(names)
    jackknife, count = np.array([fit(rest)[0] for rest in left]), len(artefacts)
    scatter = ((count - 1) * np.square(jackknife - jackknife.mean(axis=0)).mean()) ** 0.5
    few = float(student.ppf((1 + COVERAGE) / 2, count - 1)) / 2
    return _Turning(float(along), float(across), few * max(float(scatter), own_m * per_error, 1e-5))


def _span_deg(yaws_rad: Sequence[float]) -> float:
    """Return the largest angle between any two yaws, in degrees; 0 for none."""
    turns = np.exp(1j * np.array(yaws_rad))
    return float(np.degrees(np.abs(np.angle(turns[:, None] * turns.conj())).max(initial=0.0)))


def _without(
    turning: _Turning, errors_m: Mapping[str, Mapping[str, float]], yaws_rad: Mapping[str, float]
) -> dict[str, dict[str, float]]:
    """Subtract the part of the offset that turns from the errors by axis and name."""
    left = {axis: dict(rows) for axis, rows in errors_m.items()}
    for k, axis in enumerate("xy"):
        for name in left.get(axis, {}):
            left[axis][name] -= float((turning.across_m, turning.along_m) @ axes_of(yaws_rad[name])[:, k])
    return left


def _expect_sound(certificate: Path, content: dict[str, Any]) -> None:
    """Raise InputError where the rig wasn't accepted (touch-downs aside) or an offset was already
    subtracted.
    """
    if content.get("magnet_offset") is not None:
        raise InputError(certificate, "was made with a magnet's offset", "accept without --magnet first")
    wrong = [str(one["name"]) for one in content["causes"]]
    wrong += [f"the crane's travel: {one['state']}" for one in content["rig"] if one["state"] in BAD_STATES]
    wrong += [
        str(row["name"])
        for row in content["quantities"]
        if row["group"] != "touch_mm" and row["decision"] != "passed"
    ]
    if wrong:
        raise InputError(certificate, f"its rig isn't accepted ({wrong[0]})", "mend the rig, then touch down")


def _expect_spread(certificate: Path, plan: dict[str, Any], touched: set[str]) -> None:
    """Raise InputError where the artefacts that tell x and y were touched at one side of the yard only."""
    told = {str(one["name"]) for kind in ("sphere", "dummy_bundle") for one in plan[kind]} & touched
    for axis in "xy":
        places = {
            str(one["name"]): float(one[f"{axis}_m"])
            for kind in ("plate", "sphere", "dummy_bundle")
            for one in plan[kind]
        }
        whole_m = max(places.values()) - min(places.values())
        own = [places[name] for name in told]
        if len(told) >= MIN_ARTEFACTS and max(own) - min(own) < MIN_SPAN_RATIO * whole_m:
            problem = f"its touch-downs span {max(own) - min(own):.1f} m of {whole_m:.1f} m along {axis}"
            raise InputError(certificate, problem, "touch artefacts at both ends of the yard too")


def _expect_kept(certificate: Path, touches: Mapping[str, Mapping[str, float]], tolerance: Tolerance) -> None:
    """Raise InputError where two sigmas of the touch-downs' scatter, by its lower 95 % bound, are more than
    the accuracy with which the crane is said to set the magnet down.
    """
    for axis, stated_m in (("x", tolerance.x_m), ("y", tolerance.y_m)):
        errors = np.array(list(touches.get(axis, {}).values()))
        if len(errors) < 2:
            continue
        scatter_m = float(errors.std(ddof=1))
        if 2 * scatter_m / (chi2.ppf(0.95, len(errors) - 1) / (len(errors) - 1)) ** 0.5 > stated_m:
            problem = f"its touch-downs scatter by {1e3 * scatter_m:.0f} mm (1 sigma) along {axis}"
            remedy = f"find out why, or state a larger tolerance than {axis}_m = {stated_m:g}"
            raise InputError(certificate, f"{problem}, more than the magnet's tolerance holds", remedy)


def _mean_touch_m(
    certificate: Path, axis: str, errors_m: Mapping[str, float], touched: Mapping[str, str], own_m: float
) -> tuple[float, float]:
    """Average the errors along one axis; also return the sigma of the mean. touched: the artefact of each
    touch-down by name. own_m: sigma of one reading.
    """
    by_artefact: dict[str, list[float]] = {}
    for name, error in errors_m.items():
        by_artefact.setdefault(touched.get(name, name), []).append(error)
    if len(by_artefact) < MIN_ARTEFACTS:
        problem = f"its touch-downs that tell {axis} are on {len(by_artefact)} artefacts, {MIN_ARTEFACTS} are"
        remedy = "touch several spheres or dummy bundles; a plate shows z only"
        raise InputError(certificate, f"{problem} the least", remedy)
    errors = np.array(list(errors_m.values()))
    _expect_alike(certificate, axis, list(errors_m), errors, own_m)
    means = np.array([np.mean(one) for one in by_artefact.values()])
    of_readings = own_m * sum(1 / len(one) for one in by_artefact.values()) ** 0.5 / len(means)
    scatter = max(means.std(ddof=1) / len(means) ** 0.5, errors.std(ddof=1) / len(errors) ** 0.5)
    few = float(student.ppf((1 + COVERAGE) / 2, len(means) - 1)) / 2
    return float(means.mean()), few * max(float(scatter), of_readings, 1e-5)


def _expect_alike(certificate: Path, axis: str, names: list[str], errors: Float64, own_m: float) -> None:
    """Raise InputError where one touch-down lies far from the others, or they lie in two groups."""
    if np.ptp(errors) > MAX_APART_M:
        problem = f"its touch-downs lie {1e3 * np.ptp(errors):.0f} mm apart along {axis}"
        raise InputError(certificate, problem, "touch down again, the magnet at rest")
    far = int(np.abs(errors - np.median(errors)).argmax())
    others = np.delete(errors, far)
    off, scatter = abs(errors[far] - others.mean()), max(float(others.std(ddof=1)), own_m, 1e-5)
    ratio = off / scatter / (1 + 1 / len(others)) ** 0.5
    if len(errors) * 2 * student.sf(ratio, len(others) - 1) < DOUBTFUL:  # Grubbs' test
        problem = f"{names[far]} lies {1e3 * off:.0f} mm from the other touch-downs along {axis}"
        raise InputError(certificate, f"{problem}, which scatter by {1e3 * scatter:.1f} mm", "make it again")
    if len(errors) < 4:
        return
    parting, lower, gap = (one[0] for one in _parted(errors[None], max(own_m, 1e-5)))
    if parting < MIN_PARTED:
        return
    drawn = np.random.default_rng(0).normal(0, 1, (DRAWS, len(errors)))
    if np.mean(_parted(drawn, 0.0)[0] >= parting) < DOUBTFUL:
        below = ", ".join(names[k] for k in np.argsort(errors)[: int(lower)])
        problem = f"its touch-downs lie in two groups {1e3 * gap:.0f} mm apart along {axis}"
        remedy = "find out what changed (the magnet turned, a reading slipped) and touch down again"
        raise InputError(certificate, f"{problem} (the lower one: {below})", remedy)


def _parted(samples: Float64, min_scatter: float) -> tuple[Float64, Float64, Float64]:
    """Part samples (S, N) into the two groups, of two values or more each, whose means differ most in units
    of the scatter within them, at least `min_scatter`. Returns that ratio, the number of values in the lower
    group and the difference of the means, (S,) each.
    """
    ordered = np.sort(samples, axis=1)
    count = ordered.shape[1]
    lower = np.arange(2, count - 1)
    sums, squares = np.cumsum(ordered, axis=1), np.cumsum(ordered**2, axis=1)
    below = sums[:, 1 : count - 2]
    above = sums[:, -1:] - below
    within = squares[:, -1:] - below**2 / lower - above**2 / (count - lower)
    gap = above / (count - lower) - below / lower
    scatter = np.sqrt(within.clip(0) / (count - 2)).clip(max(min_scatter, 1e-9))
    ratio = gap / (scatter * np.sqrt(1 / lower + 1 / (count - lower)))
    best = ratio.argmax(axis=1)
    rows = np.arange(len(samples))
    return ratio[rows, best], lower[best].astype(np.float64), gap[rows, best]


def touch_errors_m(certificate: Path) -> dict[str, dict[str, float]]:
    """Read the errors (m) of the touch-downs by axis and name, each the mean over the recordings."""
    found: dict[str, dict[str, float]] = {}
    try:
        for row in read_certificate(certificate)["quantities"]:
            if row["group"] == "touch_mm" and row["error"] is not None:
                name, _, axis = row["name"].rpartition(": ")
                found.setdefault(axis, {})[name] = 1e-3 * float(np.mean(row["errors"]))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(certificate, f"is damaged ({type(error).__name__}: {error})", OTHER) from error
    if not in_range([error for errors in found.values() for error in errors.values()]).all():
        raise InputError(certificate, "has an impossible error", OTHER)
    return found
