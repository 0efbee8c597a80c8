"""Measure bundles in the pictures where these are finer than the map: diameters by the pitch, flanks by the
straps, things across by their edges.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from barsight.bundle_pictures.crossing_edges import edge_windows, find_edge, with_edge
from barsight.bundle_pictures.diameters import with_pitch
from barsight.bundle_pictures.flanks import MeanSection, takes_another, with_flanks
from barsight.bundle_pictures.profiles import PitchProfile, pitch_windows
from barsight.bundle_pictures.samples import PlacedFrames, sample_windows
from barsight.bundle_pictures.strap_ends import StrapEnds, find_straps, strap_windows, view_tilt
from barsight.bundle_pictures.told_straps import tell_straps
from barsight.core.pose import Pose
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.yard.bundles.floor import find_floor
from barsight.yard.placement.load import is_one_bar
from barsight.yard.types import Bundle, YardMap


@dataclass(frozen=True, eq=False)
class ShownBundles:
    """Samples of bundles in pictures.

    profiles, straps: of each bundle whose bars and flanks are searched. tilts: horizontal over vertical
    component of the lines of sight to its straps. edges: position along the axis, m from the middle, by the
    index of the bundle that an edge crosses.
    """

    profiles: list[list[PitchProfile]]
    straps: list[list[StrapEnds]]
    tilts: list[float]
    edges: dict[int, float]


def measure_from_pictures(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], heights: YardMap, bundles: Sequence[Bundle]
) -> tuple[Bundle, ...]:
    """Tell straps from thin bars, measure the flanks and bar diameters of bundles whose bars aren't counted,
    and doubt free bundles that an edge crosses. See `tell_straps`, `with_flanks` and `with_pitch`.

    poses: reference_from_body by the stamp of each frame that may be used.
    """
    bundles = tell_straps(pairs, poses, heights, bundles)
    numbers = [k for k, bundle in enumerate(bundles) if bundle.bars is None]
    unsure = [bundles[k] for k in numbers]
    shown = look_at_bundles(pairs, poses, heights, unsure, bundles)
    floor, out = find_floor(heights), list(bundles)
    seen = zip(numbers, unsure, shown.profiles, shown.straps, shown.tilts, strict=True)
    for k, bundle, profiles, ends, tilt in seen:
        told = out[k] = with_pitch(bundle, profiles)
        if ends and not is_one_bar(told):
            placed = with_flanks(told, ends, MeanSection.of(bundle, heights), floor, tilt)
            moved = placed.centre_m is not told.centre_m
            others = [other for other in bundles if moved and other is not bundle]
            out[k] = told if takes_another(placed, others) else placed
    for k, along_m in shown.edges.items():
        out[k] = with_edge(out[k], along_m)
    return tuple(out)


def look_at_bundles(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], heights: YardMap, unsure: Sequence[Bundle],
    crossed: Sequence[Bundle],
) -> ShownBundles:  # fmt: skip
    """Sample profiles and straps of `unsure` bundles, and edges on those that may be `crossed`.

    poses: as for `measure_from_pictures`.
    """
    frames = PlacedFrames.of(pairs.rectifier, poses)
    windows = list(pitch_windows(frames, heights, unsure))
    first_strap = len(windows)
    windows += strap_windows(frames, {k for k, _ in windows}, heights, unsure)
    first_edge = len(windows)
    windows += edge_windows(frames, {k for k, _ in windows}, crossed)
    looked_at, edges = set[int](), dict[int, float]()
    profiles, straps = [list[PitchProfile]() for _ in unsure], [list[StrapEnds]() for _ in unsure]
    for place, picture in sample_windows(pairs, frames, windows):
        _, window = windows[place]
        if place >= first_edge:
            # One picture of a frame tells: the other shows the same.
            if place not in looked_at and window.number not in edges:
                looked_at.add(place)
                edge = find_edge(picture.gray, window, crossed[window.number])
                if edge is not None:
                    edges[window.number] = edge
            continue
        if not picture.is_sharp:
            continue
        if place >= first_strap:
            straps[window.number] += find_straps(picture, window, unsure[window.number])
        else:
            profiles[window.number].append(PitchProfile.of(picture))
    tilts = [0.0] * len(unsure)
    for k, window in windows[first_strap:first_edge]:
        tilts[window.number] = max(tilts[window.number], abs(view_tilt(frames, k, window)))
    return ShownBundles(profiles, straps, tilts, edges)
