"""Find the bundles of a mapped yard, first in its map, then in its pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from barsight.bundle_pictures.measuring import measure_from_pictures
from barsight.bundle_pictures.space_carving import carve_beside
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.labels.bundle_labels import label_bundles
from barsight.pipeline.mapped_yard import MappedYard
from barsight.reconstruction.joined_passes import MappedPass
from barsight.yard.bundles.bundle_kinds import listed_diameter
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.strapped_bundles import doubted_if_narrow, doubted_without_straps
from barsight.yard.types import Bundle, YardMap


def find_yard_bundles(mapped: MappedYard, heights: YardMap) -> tuple[Bundle, ...]:
    """Find the bundles, and measure their bars, straps and labels in the newest pass's pictures only: what
    earlier passes saw may be gone.
    """
    settings, newest = mapped.settings, mapped.newest
    poses = {frame.stamp_ns: frame.reference_from_body for frame in newest.way.trajectory.frames}
    with mapped.watch("bundles"):
        bundles = find_bundles(heights, settings.bundles, _baseline(newest))
        if mapped.joined is not None:
            bundles = mapped.joined.doubted(bundles)
    with mapped.watch("pictures"):
        measured = measure_from_pictures(newest.probed.pairs, _mapped_poses(newest), heights, bundles)
        listed = (listed_diameter(bundle, settings.bundles.catalogue_mm) for bundle in measured)
        bundles = tuple(doubted_if_narrow(doubted_without_straps(bundle)) for bundle in listed)
    if not settings.labels.read:
        return bundles
    with mapped.watch("labels"):
        return label_bundles(newest.probed.pairs, poses, heights, bundles, settings.labels)


def carve_gullies(mapped: MappedYard, heights: YardMap, bundles: Sequence[Bundle]) -> None:
    """Lower the bounds of what stands unseen beside bundles, by the newest pass's pictures."""
    newest, surface = mapped.newest, mapped.surface
    with mapped.watch("gullies"):
        for carved in carve_beside(newest.probed.pairs, _mapped_poses(newest), heights, bundles):
            column, row = surface.columns[0] + carved.column, surface.rows[0] + carved.row
            mapped.free.lower(column, row, carved.bound_m)


def _mapped_poses(one: MappedPass) -> dict[int, Pose]:
    """Return reference_from_body by the stamp of each frame in the map."""
    used = set(one.built.stamps_ns)
    frames = one.way.trajectory.frames
    return {frame.stamp_ns: frame.reference_from_body for frame in frames if frame.stamp_ns in used}


def _baseline(one: MappedPass) -> Float64:
    """Average the horizontal unit vector (2,) from the left camera to the right one."""
    right = one.way.rectifier.body_from_rect0.rotation[:, 0]
    poses = (frame.reference_from_body for frame in one.way.trajectory.frames)
    mean = np.mean([pose.rotation @ right for pose in poses], axis=0)[:2]
    return np.asarray(mean / np.linalg.norm(mean))
