"""Check that no thin bar lies loose across a load: matching sees none under three pixels."""

from __future__ import annotations

import math

from barsight.yard.lift_settings import LiftSettings
from barsight.yard.thin_lines import MAX_STRENGTH, ThinLine
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Check, check_max, check_true

CODE = "thin-bar"
FOUND_PX = 1.8
"""Diameter of a bar, in the photo's pixels, from which on nine of ten are found."""


def thin_bar_checks(
    heights: HeightMap, line: ThinLine | None, load: tuple[Bundle, ...], pixel_m: float | None,
    settings: LiftSettings,
) -> list[Check]:  # fmt: skip
    """Check that no thin bar lies across the load, and that the pictures would show one.

    line: of the load, None where the photo doesn't show enough of it. pixel_m: of the pictures on the
    load, NaN where it isn't known; None for a map that no pictures made: then nothing is checked where
    there is no photo either.
    """
    if not load or (pixel_m is None and heights.tops is None):
        return []
    what = "strength of the strongest line across the load that is no strap"
    if line is None:
        reason = "no photo shows whether a thin bar lies across the load: measure the recording again"
        return [check_true(CODE, what, None, reason)]
    reason = (
        f"a line runs across the load {line.along_m:+.2f} m along it from its middle, "
        f"{abs(line.askew_deg):.0f} deg askew: a thin bar may lie there"
    )
    checks = [check_max(CODE, what, line.strength, MAX_STRENGTH, "sigma", reason)]
    if pixel_m is not None:
        hidden_m = FOUND_PX * max(pixel_m, heights.cell_m)
        reason = (
            f"a bar of {1e3 * hidden_m:.0f} mm across the load may not show in the pictures, "
            f"{1e3 * settings.max_hidden_bar_m:.0f} mm are allowed"
            if math.isfinite(hidden_m)
            else "how fine the pictures are is not known: measure again"
        )
        checks.append(
            check_max(
                CODE, "thickest bar across the load that the pictures may not show", 1e3 * hidden_m,
                1e3 * settings.max_hidden_bar_m, "mm", reason,
            )
        )  # fmt: skip
    return checks
