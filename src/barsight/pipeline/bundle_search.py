"""Find the bundles of a mapped yard: in its map, then in its pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.bundle_pictures.measuring import measure_from_pictures
from barsight.core.arrays import Float64
from barsight.labels.bundle_labels import label_bundles
from barsight.pipeline.mapped_yard import MappedYard
from barsight.reconstruction.joined_passes import MappedPass
from barsight.yard.bundles.bundle_kinds import listed_diameter
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.strapped_bundles import doubted_without_straps
from barsight.yard.types import Bundle, YardMap


def find_yard_bundles(mapped: MappedYard, heights: YardMap) -> tuple[Bundle, ...]:
    """Find the bundles, and look at their bars, straps and labels in the newest pass's pictures: what lay
    there before may be gone.
    """
    settings, newest = mapped.settings, mapped.newest
    poses = {frame.stamp_ns: frame.reference_from_body for frame in newest.way.trajectory.frames}
    with mapped.watch("bundles"):
        bundles = find_bundles(heights, settings.bundles, _baseline(newest))
        if mapped.joined is not None:
            bundles = mapped.joined.doubted(bundles)
    with mapped.watch("pictures"):
        used = set(newest.built.stamps_ns)
        seen = {stamp: pose for stamp, pose in poses.items() if stamp in used}
        measured = measure_from_pictures(newest.probed.pairs, seen, heights, bundles)
        listed = (listed_diameter(bundle, settings.bundles.catalogue_mm) for bundle in measured)
        heading = _heading_sigma(newest)
        bundles = tuple(_turned(doubted_without_straps(bundle), heading) for bundle in listed)
    if not settings.labels.read:
        return bundles
    with mapped.watch("labels"):
        return label_bundles(newest.probed.pairs, poses, heights, bundles, settings.labels)


def _heading_sigma(one: MappedPass) -> float:
    """Return the median standard deviation of the body's heading, rad: it turns the whole map."""
    variances = [frame.covariance[2, 2] for frame in one.way.trajectory.frames]
    return float(np.sqrt(np.median(variances)))


def _turned(bundle: Bundle, heading_rad: float) -> Bundle:
    """Add the trajectory's standard deviation of heading to a bundle's yaw."""
    yaw = float(np.hypot(bundle.sigma.yaw_rad, heading_rad))
    return replace(bundle, sigma=replace(bundle.sigma, yaw_rad=yaw))


def _baseline(one: MappedPass) -> Float64:
    """Average the level unit vector (2,) from the left camera to the right one."""
    right = one.way.rectifier.body_from_rect0.rotation[:, 0]
    poses = (frame.reference_from_body for frame in one.way.trajectory.frames)
    mean = np.mean([pose.rotation @ right for pose in poses], axis=0)[:2]
    return np.asarray(mean / np.linalg.norm(mean))
