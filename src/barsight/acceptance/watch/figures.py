"""Extract from a survey the figures that are watched."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np

from barsight.acceptance.observation import Observation
from barsight.acceptance.pictures import PictureHealth
from barsight.acceptance.watch.record import WatchedFigure
from barsight.artefacts.plan import AcceptancePlan, ErrorLimits
from barsight.core.errors import Failed
from barsight.motion.rig_check.drift_check import RigCheck
from barsight.registration.surveyed_targets import SurveyedTags
from barsight.registration.tags import PlacedTag

TAGS = "place of tags along"
"""Name of the tags' figures, without the axis."""
SHARPNESS_SIGMA = 0.15
"""Standard deviation of the logarithm of a picture's sharpness, which varies between yards."""


def rig_figures(check: RigCheck) -> tuple[WatchedFigure, ...]:
    """Extract the rig's figures from rows and travel: baseline, pitch, roll, focal ratio, and the yaw by each
    of both. The calibration's uncertainty is the same in all surveys, so sigmas cover noise only.

    It shifts the yaw by rows against that by travel, which therefore aren't averaged: their weights change
    with the travel.
    """
    noise = {} if isinstance(check.rows, Failed) else dict(
        zip(("pitch", "roll", "focal ratio"), check.rows.sigmas / check.row_sigmas, strict=False)
    )  # fmt: skip
    figures = [
        WatchedFigure(f"{line.name} / {line.unit}", line.value, line.sigma * float(noise.get(line.name, 1)))
        for line in check.lines
        if isfinite(line.value) and isfinite(line.sigma) and not line.name.startswith("yaw")
    ]
    if not isinstance(check.rows, Failed):
        yaw, sigma = np.degrees([check.rows.values[3], check.rows.sigmas[3]]).tolist()
        figures.append(WatchedFigure("yaw by rows / deg", yaw, sigma))
    if not isinstance(check.drift, Failed):
        yaw, sigma = np.degrees([check.drift.yaw_rad, check.drift.yaw_sigma_rad]).tolist()
        figures.append(WatchedFigure("yaw by travel / deg", yaw, sigma))
    return tuple(figures)


def picture_figures(health: tuple[PictureHealth, ...] | Failed) -> tuple[WatchedFigure, ...]:
    """Compute the logarithm of each camera's sharpness."""
    if isinstance(health, Failed):
        return ()
    return tuple(
        WatchedFigure(f"sharpness of {one.camera} / log", float(np.log(one.sharpness)), SHARPNESS_SIGMA)
        for one in health
    )


def feature_figures(plan: AcceptancePlan, seen: Observation) -> tuple[WatchedFigure, ...] | Failed:
    """Compute the mean errors (mm) of fixed features: heights of plates and places of surveyed spheres.
    Failed `not-found` where none of either was found: the rig may see the yard too far off.
    """
    surveyed = [one for one in plan.sphere if one.place_sigma_m is not None]
    for kind in ([seen.plates[one.name] for one in plan.plate], [seen.spheres[one.name] for one in surveyed]):
        lost = [str(found) for found in kind if isinstance(found, Failed)]
        if kind and len(lost) == len(kind):
            return Failed("not-found", "; ".join(lost))
    z = [
        1e3 * (found.z_m - one.z_m)
        for one in plan.plate
        if not isinstance(found := seen.plates[one.name], Failed)
    ]
    places = [
        1e3 * (ball.centre_m - (one.x_m, one.y_m, one.z_m))
        for one in surveyed
        if not isinstance(ball := seen.spheres[one.name], Failed)
    ]
    px_mm = 1e3 * seen.view.px_m(0.0)
    figures = []
    if z:
        figures.append(WatchedFigure("height of plates / mm", float(np.mean(z)), 0.02 * px_mm))
    if places:
        ground_mm = 1e3 * float(seen.view.camera_m[2]) / seen.view.focal_px
        x, y, _ = np.mean(places, axis=0)
        figures += [
            WatchedFigure("place of spheres along x / mm", float(x), 0.15 * ground_mm),
            WatchedFigure("place of spheres along y / mm", float(y), 0.15 * ground_mm),
        ]
    return tuple(figures)


def beyond_limits(limits: ErrorLimits, figures: Sequence[WatchedFigure]) -> list[str]:
    """List the fixed features whose mean error is beyond its limit by over two sigmas: what is normal is
    learned, so that a rig that moved before its first survey raises no alarm by the charts.
    """
    found = []
    for figure in figures:
        name = figure.name.partition(" / ")[0]
        limit = limits.height_mm if name in ("height of plates", f"{TAGS} z") else limits.position_mm
        is_fixed = name.startswith(("height of plates", "place of spheres", TAGS))
        if is_fixed and abs(figure.value) - 2 * figure.sigma > limit:
            found.append(f"{name} is {figure.value:+.1f} mm off, the limit is {limit:g}")
    return found


def tag_figures(
    listed: SurveyedTags, placed: Sequence[PlacedTag | Failed]
) -> tuple[WatchedFigure, ...] | Failed:
    """Compute the mean error (mm) along each axis of surveyed tags on columns and floor, with their common
    sigma. Failed `not-found` where no tag was located.
    """
    found = [
        (1e3 * (tag.place_m - place), 1e6 * np.diag(tag.covariance_m2))
        for tag, place in zip(placed, listed.yard_m, strict=True)
        if not isinstance(tag, Failed)
    ]
    if not found:
        return Failed("not-found", "; ".join(one.reason for one in placed if isinstance(one, Failed)))
    off, variance = (np.mean(part, axis=0) for part in zip(*found, strict=True))
    return tuple(
        WatchedFigure(f"{TAGS} {axis} / mm", float(off[k]), float(variance[k] ** 0.5))
        for k, axis in enumerate("xyz")
    )
