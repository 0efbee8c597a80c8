"""Find AprilTags in a recording's pairs and place them in the trajectory's frame, with covariance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from barsight.calibration.boards.marker_detection import find_tags, fit_tag
from barsight.calibration.boards.ring_detection import find_rings
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64, UInt8
from barsight.core.errors import Failed
from barsight.core.linalg.robust import CHI2_3_MEDIAN, mad_sigma
from barsight.core.pose import skew
from barsight.core.records.pairs import RectifiedCamera, RefusedFrame, StereoFrame
from barsight.core.records.trajectory import PosedFrame
from barsight.registration.rigid import Alignment, align_rigid

MIN_PAIRS = 2
"""Minimum number of pairs that must show a tag."""
MAX_ROWS_PX = 2.0
"""Maximum difference between the rows of a tag's corners in the two pictures: beyond it they are two tags, or
the rig is misaligned.
"""
MIN_SIGMA_PX = 0.03
"""Lower bound of the noise of a tag's middle in one picture."""
MAX_CHI2 = 16.3
"""Maximum chi2 of a pair's three coordinates, exceeded by one in a thousand."""
MAX_APART_M = 0.1
"""Maximum distance of a pair's position from the tag's; if two or more pairs exceed it, they saw another
tag.
"""
OTHER_FAMILIES = ("25h9", "36h10", "16h5")
"""Families whose tags are reported where the yard's own aren't found."""
MIRRORED_RATIO = 0.2
"""Ratio of misfits below which the mirrored positions are the right ones."""


@dataclass(frozen=True, eq=False)
class TagSighting:
    """One tag in one pair. stamp_ns: of the pair; body_m: (3,) the tag's middle in the body. place_m: (3,)
    the same in the trajectory's frame. noise_m2: (3, 3) its covariance for one pixel of noise in either
    picture; pose_m2: (3, 3) that due to the pose. rows_px: difference of its rows between the pictures;
    side_px: its shortest side; camera_m: (3,) the left camera's position.
    """

    stamp_ns: int
    body_m: Float64
    place_m: Float64
    noise_m2: Float64
    pose_m2: Float64
    rows_px: float
    side_px: float
    camera_m: Float64


@dataclass(frozen=True, eq=False)
class PlacedTag:
    """One tag from all its pairs. place_m: (3,), covariance_m2: (3, 3), including the poses' share. pairs:
    number used; left_out: number that don't agree. side_px: median. camera_m: (3,) one position it was seen
    from.
    """

    number: int
    place_m: Float64
    covariance_m2: Float64
    pairs: int
    left_out: int
    side_px: float
    camera_m: Float64


@dataclass(eq=False)
class SeenTags:
    """Sightings by tag number, numbers of pictures that show a tag twice, by tag number, and number of pairs
    searched. names: of targets that have no number; known_px: noise of a middle in one picture where rows
    don't show it. are_rings: whether they are coded circles.
    """

    sightings: dict[int, list[TagSighting]] = field(default_factory=dict)
    twice: Counter[int] = field(default_factory=Counter)
    pairs: int = 0
    names: tuple[str, ...] = ()
    known_px: float | None = None
    are_rings: bool = False

    def name(self, number: int) -> str:
        """Name a tag, coded circle or target."""
        kind = "ring" if self.are_rings else "tag"
        return f"target {self.names[number]}" if self.names else f"{kind} {number}"

    @property
    def sigma_px(self) -> float:
        """Estimate the noise of a middle in one picture from the row differences between the pictures."""
        if self.known_px is not None:
            return self.known_px
        rows_px = np.array([one.rows_px for seen in self.sightings.values() for one in seen])
        return max(MIN_SIGMA_PX, mad_sigma(rows_px) / 2**0.5) if rows_px.size else MIN_SIGMA_PX

    def moved(self, posed: dict[int, PosedFrame]) -> SeenTags:
        """Place the sightings by other poses of the same pairs; those without a pose are left out."""
        return SeenTags(
            {
                number: [
                    replace(one, place_m=posed[one.stamp_ns].reference_from_body.apply(one.body_m[None])[0])
                    for one in seen
                    if one.stamp_ns in posed
                ]
                for number, seen in self.sightings.items()
            },
            self.twice, self.pairs, self.names, self.known_px, self.are_rings,
        )  # fmt: skip

    def place(self, number: int) -> PlacedTag | Failed:
        """Combine a tag's pairs. Failed `few-pairs`, `ambiguous`."""
        seen = self.sightings.get(number, [])
        if self.twice[number] >= MIN_PAIRS:
            name = self.name(number)
            return Failed("ambiguous", f"{name} is there twice: each number may lie in the yard once")
        if len(seen) < MIN_PAIRS:
            count = "no pair" if not seen else "1 pair only"
            return Failed("few-pairs", f"{self.name(number)} is seen in {count}, {MIN_PAIRS} are the least")
        return _combined(number, self.name(number), seen, self.sigma_px)


def see_tags(
    frames: Iterable[StereoFrame | RefusedFrame], rectifier: Rectifier, posed: dict[int, PosedFrame],
    count: Callable[[], None], *, are_rings: bool = False,
) -> SeenTags:  # fmt: skip
    """Find tags, or coded circles, in the raw pairs whose pose is known. count: called after each pair."""
    seen = SeenTags(are_rings=are_rings)
    for frame in frames:
        if isinstance(frame, StereoFrame) and rectifier.wrong_size(frame) is None:
            seen.pairs += 1
            left, right = (_corners(one, seen.twice, are_rings) for one in (frame.left, frame.right))
            for number in left.keys() & right.keys():
                one = _triangulated(left[number], right[number], rectifier, posed[frame.stamp_ns])
                if one is not None:
                    seen.sightings.setdefault(number, []).append(one)
        count()
    return seen


def other_family(frames: Iterable[StereoFrame | RefusedFrame]) -> str | None:
    """Find another family of tags, of which at least two left pictures show the same tag."""
    shown = Counter(
        (family, number)
        for frame in frames
        if isinstance(frame, StereoFrame)
        for family in OTHER_FAMILIES
        for number in set(find_tags(frame.left, 1, family)[0].tolist())
    )
    return next((family for (family, _), count in shown.most_common(1) if count >= MIN_PAIRS), None)


def _corners(image: UInt8, twice: Counter[int], are_rings: bool) -> dict[int, Float64]:
    """Find the fitted corners (4, 2) of the tags that a picture shows once; count those it shows
    repeatedly.
    """
    numbers, quads = find_rings(image) if are_rings else find_tags(image)
    repeated = {int(n) for n, times in Counter(numbers.tolist()).items() if times > 1}
    twice.update(repeated)
    found = {
        int(number): quad if are_rings else fit_tag(image, int(number), quad)
        for number, quad in zip(numbers, quads, strict=True)
        if int(number) not in repeated
    }
    return {number: corners for number, corners in found.items() if corners is not None}


def _triangulated(
    left: Float64, right: Float64, rectifier: Rectifier, frame: PosedFrame
) -> TagSighting | None:
    """Triangulate the middle of a tag from its raw corners (4, 2); None where they don't belong to one
    tag.
    """
    camera, (flat_left, flat_right) = rectifier.camera, rectifier.places(left, right)
    first, second = _middle(flat_left), _middle(flat_right)
    disparity = first[0] - second[0] + camera.doffs_px
    if np.abs(flat_left[:, 1] - flat_right[:, 1]).max() > MAX_ROWS_PX or disparity <= 0:
        return None
    side_px = float(np.linalg.norm(flat_left - np.roll(flat_left, 1, axis=0), axis=1).min())
    seen_m, noise = _point(first, second, disparity, camera)
    return sighting_at(seen_m, noise, float(first[1] - second[1]), side_px, rectifier, frame)


def sighting_at(
    seen_m: Float64, noise: Float64, row_px: float, side_px: float, rectifier: Rectifier, frame: PosedFrame
) -> TagSighting:
    """Transform a point (3,) of `rect0` and its covariance (3, 3) to the body and the trajectory's frame."""
    body = frame.reference_from_body
    at = rectifier.body_from_rect0.apply(seen_m[None])[0]
    turn = body.rotation @ rectifier.body_from_rect0.rotation
    carry = np.hstack([-skew(body.rotation @ at), np.eye(3)])
    return TagSighting(
        frame.stamp_ns, at, body.apply(at[None])[0], turn @ noise @ turn.T,
        carry @ frame.covariance @ carry.T, row_px, side_px,
        body.apply(rectifier.body_from_rect0.translation[None])[0],
    )  # fmt: skip


def _middle(corners: Float64) -> Float64:
    """Intersect the diagonals of corners (4, 2): the projection of the square's middle, whatever its tilt."""
    along, across = corners[2] - corners[0], corners[3] - corners[1]
    share = np.linalg.solve(np.column_stack([along, -across]), corners[1] - corners[0])[0]
    middle: Float64 = corners[0] + share * along
    return middle


def _point(
    first: Float64, second: Float64, disparity: float, camera: RectifiedCamera
) -> tuple[Float64, Float64]:
    """Triangulate a point (3,) in `rect0`, and its covariance (3, 3) for a pixel of noise in each picture."""
    depth = camera.focal_px * camera.baseline_m / disparity
    ray = np.array([
        (first[0] - camera.cx_px) / camera.focal_px,
        ((first[1] + second[1]) / 2 - camera.cy_px) / camera.focal_px, 1.0,
    ])  # fmt: skip
    by_left = -depth / disparity * ray + [depth / camera.focal_px, 0, 0]
    by_right = depth / disparity * ray
    by_row = np.array([0, depth / camera.focal_px, 0]) / 2**0.5
    rows = np.stack([by_left, by_right, by_row])
    return depth * ray, rows.T @ rows


def _combined(number: int, name: str, seen: list[TagSighting], sigma_px: float) -> PlacedTag | Failed:
    """Combine a tag's pairs without outliers. The poses' share of the variance isn't averaged down, since the
    errors of neighbouring poses are common.
    """
    places = np.stack([one.place_m for one in seen])
    noise = sigma_px**2 * np.stack([one.noise_m2 for one in seen])
    spread = noise + np.stack([one.pose_m2 for one in seen])
    weights = np.linalg.inv(spread)
    middle, kept = np.median(places, axis=0), np.ones(len(seen), bool)
    for _ in range(5):
        off = places - middle
        chi2 = np.einsum("ki,kij,kj->k", off, weights, off)
        near = np.linalg.norm(off, axis=1) <= MAX_APART_M
        kept = near & (chi2 <= MAX_CHI2 * max(1.0, float(np.median(chi2)) / CHI2_3_MEDIAN))
        if (~near).sum() >= 2 or kept.sum() < MIN_PAIRS:
            apart = float(np.linalg.norm(np.ptp(places, axis=0)))
            reason = f"{name} is seen at places {apart:.2f} m apart: it is there twice, or was moved"
            return Failed("ambiguous", reason)
        total = weights[kept].sum(axis=0)
        middle = np.linalg.solve(total, np.einsum("kij,kj->i", weights[kept], places[kept]))
    strays = max(1.0, float(chi2[kept].sum()) / (3 * (int(kept.sum()) - 1)))
    shared = (spread - noise)[kept].mean(axis=0)
    return PlacedTag(
        number, middle, strays * (np.linalg.inv(total) + shared),
        int(kept.sum()), int((~kept).sum()), float(np.median([one.side_px for one in seen])),
        seen[0].camera_m,
    )  # fmt: skip


def turned_covariance(tags: tuple[PlacedTag, ...], yard_m: Float64, sigma_m: Float64) -> Float64:
    """Rotate the tags' covariances into yard axes and add the survey's variance, of sigma (N,); (N, 3, 3)."""
    spread = np.stack([one.covariance_m2 for one in tags])
    found = align_rigid(np.stack([one.place_m for one in tags]), yard_m, ("yard", "seen"))
    turn = np.eye(3) if isinstance(found, Failed) else found.target_from_source.rotation
    covariance: Float64 = turn @ spread @ turn.T + sigma_m[:, None, None] ** 2 * np.eye(3)
    return covariance


def is_mirrored(tags: tuple[PlacedTag, ...], yard_m: Float64, found: Alignment) -> bool:
    """Check whether the surveyed positions (N, 3) are a mirror image: they fit far better mirrored, or they
    put the cameras under the tags.
    """
    pose, places = found.target_from_source, np.stack([one.place_m for one in tags])
    cameras = np.stack([one.camera_m for one in tags])
    if np.median(pose.apply(cameras)[:, 2] - pose.apply(places)[:, 2]) < 0:
        return True
    other = align_rigid(places, yard_m * [1.0, 1.0, -1.0], ("yard", "seen"))
    if isinstance(other, Failed):
        return False
    misfit = np.linalg.norm(pose.apply(places) - yard_m)
    return bool(misfit > MAX_APART_M and np.linalg.norm(other.residuals_m) < MIRRORED_RATIO * misfit)
