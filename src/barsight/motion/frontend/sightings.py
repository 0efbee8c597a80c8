"""Define the points that a frame sees, and how its motion and its disparities deviate from the expected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64, Int64
from barsight.core.motion_detail import NormalisedResiduals
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.stamps import NS_PER_S
from barsight.features.guided_matching import PredictedMotion, triangulate_stereo

MIN_IN_QUARTER = 30
"""Minimum number of points in a quarter of the picture by which its disparities are judged."""
MEDIAN_SIGMAS = 1.4826 * 1.2533
"""Sigma of a median, in terms of the median deviation over the root of the number."""
MIN_STEP_PX = 0.1
"""Smallest step of the disparities (px) that is reported: within it, the calibration's own sigma holds it. On
drawn yards, and beside still cameras, steps are 0.03 px at most.
"""
STEP_SIGMAS, USUAL_STEPS = 8.0, 5.0
"""Smallest step that is reported, in its sigma and in terms of the usual ones: from a car, which goes far
ahead from frame to frame, they are 0.1 px, and up to 0.24 px.
"""


@dataclass(frozen=True, eq=False)
class Sighting:
    """Tracked points of one frame. track: (N,) names of points; stereo: (N, 3) u, v and right u, px;
    sigma_px: (N,) noise of each, as the patch alignment shows it.

    motion: of `rect0` since the previous sighting; None for the first of a chain, which nothing ties to the
    previous one. again: an earlier sighting that points named in both tie it to. ambiguous: number of points
    rejected because the prediction was too coarse to tell the bars apart. innovation: (6,) turn and way of
    `motion` minus the predicted ones in sigma, None without a prediction. step: of the disparities, None
    where too few points show it. sides_apart: only the left picture follows from the one before.
    """

    stamp_ns: int
    track: Int64
    stereo: Float64
    sigma_px: Float64
    motion: PredictedMotion | None
    ambiguous: int
    innovation: Float64 | None = None
    again: SeenAgain | None = None
    step: DisparityStep | None = None
    sides_apart: bool = False


@dataclass(frozen=True, eq=False)
class SeenAgain:
    """Place seen again: the stamp of the last sighting before a loss, and the motion of `rect0` since
    then.
    """

    stamp_ns: int
    motion: PredictedMotion


@dataclass(frozen=True)
class DisparityStep:
    """Disparities of a frame minus those that the previous frame's points have by the left camera's motion: a
    step if the cameras have moved against each other.

    px, sigma_px: median over the quarter of the picture where it is largest, and its sigma. depth_m: depth
    error that it causes at range_m, the points' median depth.
    """

    stamp_ns: int
    px: float
    sigma_px: float
    depth_m: float
    range_m: float


def disparity_step(
    stamp_ns: int, old: Float64, new: Float64, motion: PredictedMotion, camera: RectifiedCamera
) -> DisparityStep | None:
    """Compare the disparities of points (N, 3) in two frames; None where too few are in any quarter."""
    points = triangulate_stereo(old, camera) @ motion.rotation.T + motion.translation
    scale_px_m = camera.focal_px * camera.baseline_m
    off = new[:, 0] - new[:, 2] + camera.doffs_px - scale_px_m / points[:, 2]
    quarter = 2 * (new[:, 0] > camera.width / 2) + (new[:, 1] > camera.height / 2)
    parts = [off[(quarter == k) & np.isfinite(off)] for k in range(4)]
    medians = {k: float(np.median(part)) for k, part in enumerate(parts) if part.size >= MIN_IN_QUARTER}
    if not medians:
        return None
    worst = max(medians, key=lambda k: abs(medians[k]))
    part, px = parts[worst], medians[worst]
    sigma_px = MEDIAN_SIGMAS * float(np.median(np.abs(part - px))) / part.size**0.5
    range_m = float(np.nanmedian(points[:, 2]))
    return DisparityStep(stamp_ns, px, sigma_px, -px * range_m**2 / scale_px_m, range_m)


def rig_moved(steps: Sequence[DisparityStep], sides_apart: int, stamps_ns: Sequence[int]) -> tuple[str, ...]:
    """Describe what shows that the cameras have moved against each other, if anything does.

    sides_apart: number of frames whose right pictures contradict the left ones. stamps_ns: of the
    recording's frames.
    """
    return _largest_step(steps, stamps_ns) + _sides_sentences(sides_apart)


def _largest_step(steps: Sequence[DisparityStep], stamps_ns: Sequence[int]) -> tuple[str, ...]:
    sizes = np.array([abs(step.px) for step in steps])

    def is_unusual(k: int) -> bool:
        return bool(sizes[k] > USUAL_STEPS * np.median(np.append(np.delete(sizes, k), 0.0)))

    found = [
        step for k, step in enumerate(steps)
        if sizes[k] > max(MIN_STEP_PX, STEP_SIGMAS * step.sigma_px) and is_unusual(k)
    ]  # fmt: skip
    if not found:
        return ()
    worst = max(found, key=lambda step: abs(step.px))
    at = (worst.stamp_ns - stamps_ns[0]) / NS_PER_S
    return (
        f"the cameras have moved against each other {at:.1f} s after the first frame: disparities change by "
        f"{worst.px:+.2f} px, which moves depths at {worst.range_m:.1f} m by {1e3 * worst.depth_m:+.0f} mm; "
        "fasten them, calibrate anew and survey again; or trigger both by one signal, if they aren't",
    )


def _sides_sentences(count: int) -> tuple[str, ...]:
    if count == 0:
        return ()
    return (
        f"in {count} frame{'s' * (count > 1)} the right picture doesn't follow from the one before as the "
        "left one does, so the depth before or after it is wrong: if a camera has moved, fasten it, "
        "calibrate anew and survey again; if they don't expose at the same time, trigger both by one signal",
    )


def normalised_innovation(predicted: PredictedMotion, found: PredictedMotion) -> Float64:
    """Compute the innovation (6,): found minus predicted turn and way, each divided by its sigma."""
    turn = Rotation.from_matrix(found.rotation @ predicted.rotation.T)
    shift = found.translation - turn.as_matrix() @ predicted.translation
    sigma = np.sqrt(np.diag(predicted.covariance + found.covariance))
    return np.asarray(np.concatenate([turn.as_rotvec(), shift]) / sigma, np.float64)


def innovations(sightings: tuple[Sighting, ...]) -> NormalisedResiduals | None:
    """Collect the innovations of all frames whose motion was predicted; None if there are none."""
    known = [(s.stamp_ns, s.innovation) for s in sightings if s.innovation is not None]
    if not known:
        return None
    names = tuple(f"{part} {axis}" for part in ("turn", "way") for axis in "xyz")
    stamps = np.array([stamp for stamp, _ in known], np.int64)
    return NormalisedResiduals(names, stamps, np.array([values for _, values in known]))
