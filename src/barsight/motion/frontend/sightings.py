"""Define the points that a frame sees, and the deviation of its motion from the predicted one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64, Int64
from barsight.core.motion_detail import NormalisedResiduals
from barsight.features.guided_matching import PredictedMotion


@dataclass(frozen=True, eq=False)
class Sighting:
    """Tracked points of one frame. track: (N,) names of points; stereo: (N, 3) u, v and right u, px;
    sigma_px: (N,) noise of each, as the patch alignment shows it.

    motion: of `rect0` since the previous sighting; None for the first of a chain, which nothing ties to the
    previous one. again: an earlier sighting that points named in both tie it to. ambiguous: number of points
    rejected because the prediction was too coarse to tell the bars apart. innovation: (6,) turn and way of
    `motion` minus the predicted ones in sigma, None without a prediction.
    """

    stamp_ns: int
    track: Int64
    stereo: Float64
    sigma_px: Float64
    motion: PredictedMotion | None
    ambiguous: int
    innovation: Float64 | None = None
    again: SeenAgain | None = None


@dataclass(frozen=True, eq=False)
class SeenAgain:
    """Place seen again: the stamp of the last sighting before a loss, and the motion of `rect0` since
    then.
    """

    stamp_ns: int
    motion: PredictedMotion


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
