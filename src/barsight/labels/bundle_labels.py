"""Read the labels of a yard while it is measured, and assign the text to each bundle."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.parallel import ordered_map
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedPair, RefusedFrame
from barsight.labels.attachment import NUMBER, Label, PlacedCode, merge_codes
from barsight.labels.code_reading import SeenCode, read_codes
from barsight.labels.number_reading import label_patch, number_reader, read_number
from barsight.labels.placing import PlacedCamera, first_surface
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.yard.label_settings import LabelSettings
from barsight.yard.plates import find_plates
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, BundleLabel, YardMap

ILLEGIBLE = BundleLabel(None, "illegible", 0, 0.0)
_BELOW_M = 1.0
"""Depth below the floor down to which a line of sight is followed."""


def expect_readers(settings: LabelSettings) -> None:
    """Raise ConfigError, before anything is measured, if the packages that read the labels aren't
    installed.
    """
    if settings.read:
        read_codes(np.zeros((16, 16), np.uint8))
    if settings.numbers:
        with number_reader():
            pass


def label_bundles(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], heights: YardMap, bundles: tuple[Bundle, ...],
    settings: LabelSettings,
) -> tuple[Bundle, ...]:  # fmt: skip
    """Read the labels in the pairs that have a pose, and assign each bundle its own.

    poses: reference_from_body by stamp. A bundle gets a label if exactly one text is read on it, surely, and
    on no other bundle. If something is read but isn't sure, or only a plate of a label's size is seen, the
    label is illegible.
    Raises ConfigError without the extra `labels`.
    """
    labels = merge_codes(read_texts(pairs, poses, heights, bundles, settings), bundles)
    return tuple(
        replace(bundle, label=bundle_label(bundle, labels) or unread_label(bundle, heights, settings.size_m))
        for bundle in bundles
    )


def read_texts(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], heights: YardMap, bundles: Sequence[Bundle],
    settings: LabelSettings, count: Callable[[], None] = lambda: None,
) -> list[PlacedCode]:  # fmt: skip
    """Read the codes in the pairs that have a pose, then plain numbers on bundles where no code was read.

    count: called after each pair, twice where numbers are read.
    """
    found = list[PlacedCode]()
    for codes in placed_codes(pairs, poses, heights):
        found += codes
        count()
    if settings.numbers:
        coded = {label.bundle for label in merge_codes(found, bundles)}
        bare = [bundle for bundle in bundles if bundle.id not in coded]
        for numbers in placed_numbers(pairs, poses, heights, bare, settings.size_m):
            found += numbers
            count()
    return found


def unread_label(bundle: Bundle, heights: YardMap, size_m: tuple[float, float]) -> BundleLabel | None:
    """Return an illegible label for a bundle on which a plate of a label's size is seen."""
    return ILLEGIBLE if min(size_m) > 0 and find_plates(bundle, heights, size_m) else None


def placed_codes(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], heights: YardMap
) -> Iterator[list[PlacedCode]]:
    """Read the pairs that have a pose, and yield the codes of each with their positions on the map; a frame
    that can't be decoded yields none.

    poses: reference_from_body by stamp.
    """
    rectifier = pairs.rectifier

    def read(pair: RectifiedPair | RefusedFrame) -> tuple[int, list[tuple[SeenCode, ...]]]:
        pictures = () if isinstance(pair, RefusedFrame) else (pair.left, pair.right)
        return pair.stamp_ns, [read_codes(image) for image in pictures]

    for stamp_ns, seen in ordered_map(read, pairs(poses)):
        cameras = PlacedCamera.of_pair(poses[stamp_ns] @ rectifier.body_from_rect0, rectifier.camera)
        yield [
            PlacedCode(code.text, code.kind, place, (stamp_ns, number))
            for number, (codes, camera) in enumerate(zip(seen, cameras, strict=False)) for code in codes
            if (place := _on_the_map(heights, *camera.line_of_sight(code.middle_px))) is not None
        ]  # fmt: skip


def placed_numbers(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], heights: YardMap, bundles: Iterable[Bundle],
    size_m: tuple[float, float],
) -> Iterator[list[PlacedCode]]:  # fmt: skip
    """Read plain numbers on plates of a label's size (size_m) on bundles, pair by pair.

    Raises ConfigError without the extra `numbers` or Tesseract's data.
    """
    places = list[Float64]()
    for bundle in bundles if min(size_m) > 0 else ():
        for at in find_plates(bundle, heights, size_m):
            if not any(np.hypot(*(at - other[:2])) < min(size_m) for other in places):
                places.append(np.append(at, bundle.top_z_m))
    rectifier, size_ratio = pairs.rectifier, min(size_m) / max(max(size_m), 1e-9)
    with number_reader() as reader:
        for pair in pairs(poses) if places else ():
            pictures = () if isinstance(pair, RefusedFrame) else (pair.left, pair.right)
            cameras = PlacedCamera.of_pair(poses[pair.stamp_ns] @ rectifier.body_from_rect0, rectifier.camera)
            yield [
                PlacedCode(text, NUMBER, place, (pair.stamp_ns, number))
                for number, (picture, camera) in enumerate(zip(pictures, cameras, strict=False))
                for place in places
                if (patch := label_patch(picture, camera, place, size_m)) is not None
                and (text := read_number(reader, patch, size_ratio)) is not None
            ]  # fmt: skip


def _on_the_map(heights: YardMap, origin: Float64, direction: Float64) -> Float64 | None:
    """Intersect a line of sight with the map below it; None if it meets no known surface."""
    if direction[2] >= 0:
        return None
    ends = np.array([origin, origin - (origin[2] + _BELOW_M) / direction[2] * direction])
    return first_surface(part_about(heights, ends[:, 0], ends[:, 1]), origin, direction)


def bundle_label(bundle: Bundle, labels: Sequence[Label]) -> BundleLabel | None:
    """Choose a bundle's label from all that were read; see `label_bundles`."""
    here = [label for label in labels if label.bundle == bundle.id]
    sure = {label.text for label in here if label.is_sure}
    elsewhere = {label.text for label in labels if label.is_sure and label.bundle not in (bundle.id, None)}
    if len(sure) == 1 and all(label.text in sure for label in here) and not sure & elsewhere:
        best = max(here, key=lambda label: label.pictures)
        read = round(best.pictures / best.agreement_ratio)
        return BundleLabel(best.text, best.kind, best.pictures, (best.pictures + 1) / (read + 2))
    return ILLEGIBLE if here else None
