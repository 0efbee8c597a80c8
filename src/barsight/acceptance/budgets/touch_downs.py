"""Average the touch-downs of a certificate into the offset of the magnet from where the crane places it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from barsight.acceptance.certificate import REMEDY as OTHER
from barsight.acceptance.certificate import read_certificate
from barsight.acceptance.uncertainty import COVERAGE
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import in_range
from barsight.registration.agreement import DOUBTFUL
from barsight.yard.magnet.description import MAX_OFFSET_M, MagnetOffset

MIN_TOUCHES = 3
MAX_APART_M = 0.1
"""Maximum spread (m) along one axis of touch-downs made by one magnet at rest."""


def touched_offset(certificate: Path) -> MagnetOffset:
    """Average the touch-downs of a certificate into the magnet's offset from where the crane's readings place
    it.

    The sigma of a mean is the larger of the scatter and the sigma of one reading, over the root of their
    number, widened so that two sigma cover 95.45 % by Student's t. Raises InputError where the certificate is
    unsuitable.
    """
    content, touches = read_certificate(certificate), touch_errors_m(certificate)
    try:
        _expect_sound(certificate, content)
        rows = [row for row in content["quantities"] if row["group"] == "touch_mm"]
        own_m = 1e-3 * max((float(row["uncertainty"]["sigma"]) for row in rows), default=0.0)
        ids = str(content["calibration_id"]), str(content["yard_frame_id"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(certificate, f"is damaged ({type(error).__name__}: {error})", OTHER) from error
    errors_m = [_mean_touch_m(certificate, axis, touches.get(axis, {}), own_m) for axis in "xyz"]
    (x, x_sigma), (y, y_sigma), (z, z_sigma) = errors_m
    max_m = max(abs(x), abs(y), abs(z))
    if max_m > MAX_OFFSET_M:
        problem = f"the magnet hangs {1e3 * max_m:.0f} mm off: that is the rig's lever arm"
        raise InputError(certificate, problem, "correct p_crane_body in crane0/sensor.yaml and accept again")
    return MagnetOffset(x, y, z, x_sigma, y_sigma, z_sigma, *ids)


def _expect_sound(certificate: Path, content: dict[str, Any]) -> None:
    """Raise InputError where the rig wasn't accepted (touch-downs aside) or an offset was already
    subtracted.
    """
    if content.get("magnet_offset") is not None:
        raise InputError(certificate, "was made with a magnet's offset", "accept without --magnet first")
    wrong = [str(one["name"]) for one in content["causes"]]
    wrong += [
        str(row["name"])
        for row in content["quantities"]
        if row["group"] != "touch_mm" and row["decision"] != "passed"
    ]
    if wrong:
        raise InputError(certificate, f"its rig isn't accepted ({wrong[0]})", "mend the rig, then touch down")


def _mean_touch_m(
    certificate: Path, axis: str, errors_m: dict[str, float], own_m: float
) -> tuple[float, float]:
    """Average the errors along one axis; also return the sigma of the mean. own_m: sigma of one reading."""
    errors = np.array(list(errors_m.values()))
    if len(errors) < MIN_TOUCHES:
        problem = f"has {len(errors)} touch-downs that tell {axis}, {MIN_TOUCHES} are the least"
        raise InputError(certificate, problem, "touch spheres or dummy bundles; a plate tells z only")
    if np.ptp(errors) > MAX_APART_M:
        problem = f"its touch-downs lie {1e3 * np.ptp(errors):.0f} mm apart along {axis}"
        raise InputError(certificate, problem, "touch down again, the magnet at rest")
    far = int(np.abs(errors - np.median(errors)).argmax())
    others = np.delete(errors, far)
    off, scatter = abs(errors[far] - others.mean()), max(float(others.std(ddof=1)), own_m, 1e-5)
    ratio = off / scatter / (1 + 1 / len(others)) ** 0.5
    if len(errors) * 2 * student.sf(ratio, len(others) - 1) < DOUBTFUL:  # Grubbs' test
        problem = f"{list(errors_m)[far]} lies {1e3 * off:.0f} mm from the other touch-downs along {axis}"
        raise InputError(certificate, f"{problem}, which scatter by {1e3 * scatter:.1f} mm", "make it again")
    few = float(student.ppf((1 + COVERAGE) / 2, len(errors) - 1)) / 2
    sigma = few * max(float(errors.std(ddof=1)), own_m, 1e-5) / len(errors) ** 0.5
    return float(errors.mean()), sigma


def touch_errors_m(certificate: Path) -> dict[str, dict[str, float]]:
    """Read the errors (m) of the touch-downs by axis and name."""
    found: dict[str, dict[str, float]] = {}
    try:
        for row in read_certificate(certificate)["quantities"]:
            if row["group"] == "touch_mm" and row["error"] is not None:
                name, _, axis = row["name"].rpartition(": ")
                found.setdefault(axis, {})[name] = 1e-3 * float(row["error"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(certificate, f"is damaged ({type(error).__name__}: {error})", OTHER) from error
    if not in_range([error for errors in found.values() for error in errors.values()]).all():
        raise InputError(certificate, "has an impossible error", OTHER)
    return found
