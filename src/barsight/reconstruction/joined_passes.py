"""Join several passes over one yard, each measured as its own recording, into one map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.core.errors import InputError
from barsight.core.json_values import json_digest, json_value
from barsight.core.notices import Notice
from barsight.core.pose import Pose, nearest_rotation, skew
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.core.stamps import seconds_to_ns
from barsight.mapping.free_space import MARGIN_M, FreeSpace
from barsight.mapping.passes.changes import BundleMove, HeightChange, PlaceHistory
from barsight.mapping.passes.joined_surface import PassSurface, join_surfaces, measure_overlaps
from barsight.mapping.passes.slides import SeenBundle, find_moves
from barsight.mapping.surface.surface import Surface
from barsight.mapping.top_photo import TopPhoto
from barsight.measure_settings import MeasureSettings
from barsight.measurement import BuiltMap
from barsight.reconstruction.probed_recording import ProbedRecording
from barsight.reconstruction.tracked_recording import TrackedRecording
from barsight.recording.base import Recording
from barsight.registration.pass_ties import PairTie, PassCorrection, PassPrior, PassTies, tie_passes
from barsight.yard.types import Bundle, Doubt, DoubtKind
from barsight.yard_frame import mounting_id

MIN_SIGMA = np.array([2e-4, 2e-4, 2e-4, 0.002, 0.002, 0.002])
"""Minimum sigma of a pass's rotation (rad) and shift (m), due to springs and rails that no encoder
measures.
"""
SCALE_SIGMA = 2e-4
"""Prior sigma, as a ratio, of the scale of a pass's travel along X."""
MAX_PASSES = 127
"""Each place of the yard remembers passes by their number, in a byte."""
CHANGE_REACH_M = 0.5
"""Distance from a bundle within which a change may have affected it, if the bundle wasn't seen whole
since.
"""
STALE = Doubt(
    DoubtKind.OTHER, "the yard changed beside it between two passes, and a part of it was not seen since"
)


@dataclass(frozen=True, eq=False)
class MappedPass:
    """One measured recording: its probe, its trajectory in the common map, and its map."""

    probed: ProbedRecording
    way: TrackedRecording
    built: BuiltMap


@dataclass(frozen=True, eq=False)
class JoinedPasses:
    """Several passes joined into one map. placed: their own surfaces. ties: their relative positions;
    history: what changed between them.
    """

    passes: tuple[MappedPass, ...]
    placed: tuple[PassSurface, ...]
    surface: Surface
    free: FreeSpace
    tops: TopPhoto
    ties: PassTies
    history: PlaceHistory

    def notices(self) -> Iterator[Notice]:
        """Yield warnings about missing or contradictory ties and about changes."""
        tied = {number for pair in self.ties.pairs for number in (pair.first, pair.second)}
        for number in range(len(self.passes)):
            if number not in tied:
                reason = f"pass {number + 1} shares nothing with another: encoders alone place it beside them"
                yield Notice("passes-untied", reason)
        for pair in self.ties.pairs:
            if pair.contradicts:
                yield Notice("passes-contradict", _contradiction(pair))
        for change in self.history.changes:
            yield Notice("yard-changed", _changed(change))
        for move in self.history.moves:
            yield Notice("yard-changed", _moved_along(move))

    def doubted(self, bundles: Sequence[Bundle]) -> tuple[Bundle, ...]:
        """Mark the bundles at or beside a change that weren't seen whole since; also record the ones that
        were moved along their axis or exchanged.
        """
        for move in find_moves(self.placed, [SeenBundle(one.ends_m, one.width_m) for one in bundles]):
            self.history.note(move)
        return tuple(
            bundle.with_cover_doubt(STALE)
            if self.history.is_stale(
                bundle.centre_m, bundle.yaw_rad, bundle.length_m, bundle.width_m, CHANGE_REACH_M
            )
            else bundle
            for bundle in bundles
        )


def in_order(recordings: Sequence[Recording], settings: MeasureSettings) -> tuple[Recording, ...]:
    """Sort passes by time. Raises InputError where they can't be joined: they are too many, their cameras,
    mounting or crane differ, there are no encoders, or one pair of cameras has two recordings of the same
    time. Two pairs on one body may record at once; any other pass must be of one of those pairs.
    """
    if len(recordings) == 1:
        return tuple(recordings)
    if len(recordings) > MAX_PASSES:
        problem = f"is one of {len(recordings)} passes, {MAX_PASSES} are the most that make one map"
        raise InputError(recordings[-1].path, problem, "leave the oldest out")
    if "crane" not in settings.use or settings.self_calibrate != "none":
        raise InputError(
            recordings[0].path, "several passes are tied by the crane's encoders and one calibration",
            "measure with use: stereo,imu,crane and self_calibrate: none",
        )  # fmt: skip
    for recording in recordings:
        if not recording.index.stamps_ns:
            raise InputError(recording.path, "no stereo pair at all", "leave it out")
    ordered = sorted(recordings, key=lambda one: one.index.stamps_ns[0])
    hung, known = _hung(ordered[0]), set[str]()
    for group in _at_once(ordered):
        pairs = [json_digest(json_value(one.rig)) for one in group]
        twin = next((k for k, pair in enumerate(pairs) if pair in pairs[:k]), None)
        if twin is not None:
            problem = f"it and {group[pairs.index(pairs[twin])].path.name} were recorded at the same time"
            raise InputError(group[twin].path, problem, "name each pass once")
        odd = [one for one in group if _hung(one) != hung]
        if odd or (known and known.isdisjoint(pairs)):
            problem = f"its cameras, or their mounting on the crane, differ from those of {ordered[0].path}"
            raise InputError((odd or group)[0].path, problem, "measure passes of one rig and crane together")
        known.update(pairs)
    return tuple(ordered)


def _at_once(ordered: Sequence[Recording]) -> list[list[Recording]]:
    """Group recordings made at the same time; two pairs of cameras on one body make one each."""
    groups, end_ns = list[list[Recording]](), ordered[0].index.stamps_ns[-1]
    for one in ordered:
        if groups and one.index.stamps_ns[0] <= end_ns:
            groups[-1].append(one)
        else:
            groups.append([one])
        end_ns = max(end_ns, one.index.stamps_ns[-1])
    return groups


def _hung(recording: Recording) -> str:
    """Return the id of the body's mounting on the crane. Raises InputError without encoders."""
    crane = recording.crane()
    if crane is None:
        problem = "it has no crane encoders, which place several passes in one yard"
        raise InputError(recording.path, problem, "measure it by itself")
    return mounting_id(crane)


def join_passes(
    passes: Sequence[MappedPass], surfaces: Sequence[Surface], folder: Path, max_age_s: float
) -> JoinedPasses:
    """Tie passes by their overlaps and join their maps, the oldest first; the surface is stored in
    `folder`. max_age_s: as in `LiftSettings`.
    """
    ties = tie_passes([_prior(one.way.trajectory) for one in passes], measure_overlaps(surfaces))
    sizes = [len(group) for group in _at_once([one.probed.source for one in passes])]
    since = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes).tolist()
    placed = [PassSurface(*parts) for parts in zip(surfaces, ties.corrections, since, strict=True)]
    joined = join_surfaces(placed, folder)
    _forget_old(passes, joined.history, max_age_s)
    free, tops = passes[0].built.free, passes[0].built.tops
    free.rise(float(ties.corrections[0].unknowns[5]))
    for number, (one, correction) in enumerate(zip(passes, ties.corrections, strict=True)):
        if number == 0:
            continue
        rise_m = float(correction.unknowns[5])

        def forgotten(x_m: Float64, y_m: Float64, since: int = number) -> Bool:
            return joined.history.last_change(x_m, y_m) >= since

        free.join(one.built.free, rise_m, forgotten)
        if since[number] == number:
            for later, first in zip(passes, since, strict=True):
                if first == number:
                    tops.give_way(later.built.tops)
        tops.join(one.built.tops, forgotten)
    moved = tuple(
        replace(one, way=replace(one.way, trajectory=_moved(one.way.trajectory, correction)))
        for one, correction in zip(passes, ties.corrections, strict=True)
    )
    return JoinedPasses(moved, tuple(placed), joined.surface, free, tops, ties, joined.history)


def _forget_old(passes: Sequence[MappedPass], history: PlaceHistory, max_age_s: float) -> None:
    """Discard what a pass proved free where one that began more than max_age_s later saw anything near:
    heights show their age, proofs don't.
    """
    stamps = [one.probed.source.index.stamps_ns for one in passes]
    about = history.seen_about(MARGIN_M)
    for one, own in zip(passes, stamps, strict=True):
        ends_ns = own[-1] + seconds_to_ns(max_age_s)
        later = [number for number, other in enumerate(stamps) if other[0] > ends_ns]
        if later:

            def forgotten(x_m: Float64, y_m: Float64, first: int = later[0]) -> Bool:
                return about(x_m, y_m) >= first

            one.built.free.forget(forgotten)


def _prior(trajectory: Trajectory) -> PassPrior:
    """Compute the prior of a whole pass's error: the median covariance of its frames, but at least
    MIN_SIGMA and SCALE_SIGMA.
    """
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = np.median([frame.covariance for frame in trajectory.frames], axis=0)
    floor = np.append(MIN_SIGMA, SCALE_SIGMA) ** 2
    short = np.maximum(floor - np.diag(covariance), 0)
    values, vectors = np.linalg.eigh(covariance + np.diag(short))
    sound = (vectors * np.maximum(values, 1e-10)) @ vectors.T
    return PassPrior(trajectory.positions_m.mean(axis=0), sound)


def _moved(trajectory: Trajectory, correction: PassCorrection) -> Trajectory:
    turn, frames = nearest_rotation(np.eye(3) + skew(correction.unknowns[:3])), []
    for frame in trajectory.frames:
        pose = frame.reference_from_body
        place = pose.translation + correction.shift_at(pose.translation[None])[0]
        moved = Pose(pose.target, pose.source, turn @ pose.rotation, place)
        frames.append(PosedFrame(frame.stamp_ns, moved, frame.covariance))
    return replace(trajectory, frames=tuple(frames))


def _contradiction(pair: PairTie) -> str:
    shift, sigma, allowed = (
        ", ".join(f"{1e3 * value:.0f}" for value in values)
        for values in (pair.shift_m, pair.sigma_m, pair.expected_sigma_m)
    )
    return (
        f"pass {pair.second + 1} lies {shift} mm (x, y, z) off pass {pair.first + 1} by what both see "
        f"(sigma {sigma} mm); their own sigmas allow {allowed} mm"
    )


def _changed(change: HeightChange) -> str:
    (x0, y0), (x1, y1) = change.low_m, change.high_m
    way = "higher" if change.rise_m > 0 else "lower"
    return (
        f"before pass {change.pass_index + 1} {change.area_m2:.2f} m² between x {x0:.2f} and {x1:.2f} m, "
        f"y {y0:.2f} and {y1:.2f} m became {1e3 * abs(change.rise_m):.0f} mm {way}"
    )


def _moved_along(move: BundleMove) -> str:
    x, y = move.ends_m[:, :2].mean(axis=0)
    what = f"before pass {move.pass_index + 1} the bundle around x {x:.2f}, y {y:.2f} m"
    if move.along_m is None:
        return f"{what} was exchanged: its picture is another one's"
    way = move.ends_m[1] - move.ends_m[0] if move.along_m > 0 else move.ends_m[0] - move.ends_m[1]
    axis = int(np.argmax(np.abs(way[:2])))
    sign = "-" if way[axis] < 0 else "+"
    return f"{what} was moved {abs(move.along_m):.2f} m along itself towards {sign}{'XY'[axis]}"
