"""Check each sensor for contradictions, in itself and with the others, before estimation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.core.records.sensor_samples import CraneSamples, EncoderJump, ImuSamples
from barsight.core.stamps import NS_PER_S, interpolate_at, seconds_to_ns
from barsight.motion.crane.encoder_jumps import find_jumps, lost_counts, take_off_jumps
from barsight.motion.crane.encoder_trajectory import fit_position
from barsight.motion.crane.jump_window import WIDE_M
from barsight.motion.crane.known_motion import KnownMotion
from barsight.motion.crane.sway import turned_angle
from barsight.motion.frontend.seen_steps import seen_steps
from barsight.motion.frontend.sightings import Sighting

MIN_FROZEN = 5
SIDE, SPEED_WINDOW_S = 8, 0.3
"""Number of readings and duration, s, over which the speed before a freeze is taken; the longer one
counts.
"""
MIN_HELD_M, HELD_SIGMAS = 0.01, 8.0
"""Minimum distance, in m and in sigma of a reading (the larger counts), that a crane must have travelled
during equal readings for these to be frozen.
"""
SPEED_SIGMAS = 3.0
MAX_BRAKING_MPS2, MAX_ALONE_MPS2 = 1.0, (1.0, 4.0, 4.0)
"""Maximum braking of the crane as a whole, and of bridge, trolley and hoist alone, whose brakes differ."""
STOP_WINDOW_S = 0.1
"""Minimum duration, s, of the last steps before a freeze: in full if frozen, shorter if braking."""
MAX_FRAMES_OFF = 2
MANY_STEPS = 8
"""Minimum number of steps that must be left to try offsets of more than one frame."""
MIN_STEPS = 2
"""Minimum number of steps for an offset to be sought, as five frames leave them. Five frames reveal an offset
seven times in ten, seven frames always (docs/explanation/motion.md).
"""
WINDOW_S = 0.35
TURN_SIGMA_RAD = 5e-4
WAY_SIGMA_M = 0.005
CLEARLY_BETTER = 0.1

Stretch = tuple[int, int, tuple[int, ...]]
"""First and last reading of a freeze, by index or stamp, and the frozen axes."""


@dataclass(frozen=True, eq=False)
class CheckedCrane:
    """Usable readings with their jumps subtracted, and warnings about what was left out."""

    samples: CraneSamples
    warnings: tuple[str, ...]


def check_crane(crane: CraneSamples, known: KnownMotion | None = None) -> CheckedCrane:
    """Remove readings that stand still while the crane must be moving, and find the jumps.

    known: the travel according to pictures and IMU. After a freeze an encoder may have lost count by any
    amount, unless these show that it has not.
    """
    parts = [
        (int(crane.stamp_ns[first]), int(crane.stamp_ns[last])) for first, last, _ in frozen_stretches(crane)
    ]
    samples, after = without_frozen(crane, parts)
    after = lost_counts(samples, after, known, min_way_m(crane))
    found = find_jumps(replace(samples, jumps=after), known)
    warnings = freeze_sentences(parts, int(crane.stamp_ns[0])) if parts else ()
    return CheckedCrane(take_off_jumps(samples, (*after, *found)), warnings)


def freeze_sentences(parts: Sequence[tuple[int, int]], begin_ns: int) -> tuple[str, ...]:
    """Describe the frozen parts, each given by its first and last stamp, in seconds since `begin_ns`."""
    spans = [tuple((stamp - begin_ns) / NS_PER_S for stamp in part) for part in parts]
    return tuple(
        f"the encoders were frozen from {first:.1f} s to {last:.1f} s while the crane moved"
        for first, last in spans
    )


def min_way_m(crane: CraneSamples) -> float:
    """Return the minimum travel (m) from which encoders that stand still count as frozen."""
    return max(MIN_HELD_M, HELD_SIGMAS * max(crane.position_std_m, crane.resolution_m / 12**0.5))


def without_frozen(
    crane: CraneSamples, parts: Sequence[tuple[int, int]]
) -> tuple[CraneSamples, tuple[EncoderJump, ...]]:
    """Remove the readings of frozen parts, each given by its first and last stamp; also return the jumps that
    may have happened during them.
    """
    after: list[EncoderJump] = []
    for first_ns, last_ns in parts:
        crane = _chosen(crane, (crane.stamp_ns < first_ns) | (crane.stamp_ns > last_ns))
        for begins in crane.stamp_ns[crane.stamp_ns > last_ns][:1].tolist():
            after += [EncoderJump(begins, axis, 0.0, WIDE_M, "freeze") for axis in range(3)]
    return crane, tuple(after)


@dataclass(frozen=True, eq=False)
class StepComparison:
    """Measurements of the same K steps between frames by the pictures and by the other sensors.

    turn: (K, 3) rotation vector old body from new body and way: (K,) m by the pictures. gyro: (K, 3) and
    travel: (K,) by IMU and encoders, NaN where they don't cover the step. seconds: (K,).
    """

    turn: Float64
    way: Float64
    gyro: Float64
    travel: Float64
    seconds: Float64


def compare_steps(
    sightings: tuple[Sighting, ...], imu: ImuSamples | None, crane: CraneSamples | None,
    rectifier: Rectifier, shift_ns: int, offs: tuple[int, ...] = (0,),
) -> tuple[StepComparison, ...]:  # fmt: skip
    """Measure the steps once for each of `offs`, with the other sensors read that many frames later. The
    steps are the same for all offsets, so those of the outer frames are left out.
    """
    count, ends = len(sightings), max(abs(off) for off in offs)
    steps = [k for k in range(1 + ends, count - ends) if sightings[k].motion is not None]
    stamps = np.array([s.stamp_ns for s in sightings]) + shift_ns
    seen = seen_steps(sightings, steps, rectifier, shift_ns)
    angle, place = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    if imu is not None:
        angle = interpolate_at(stamps, imu.stamp_ns, turned_angle(imu))
    if crane is not None:
        # A fit is robust to single outliers.
        for k, stamp in enumerate(stamps.tolist()):
            fit = fit_position(crane, stamp, seconds_to_ns(WINDOW_S))
            place[k] = np.nan if isinstance(fit, Failed) else fit.position_m
    found = []
    for off in offs:
        old, new = [k + off - 1 for k in steps], [k + off for k in steps]
        travel = np.linalg.norm(place[new] - place[old], axis=1)
        found.append(
            StepComparison(
                seen.turn,
                np.linalg.norm(seen.way_m, axis=1),
                angle[new] - angle[old],
                travel,
                (stamps[new] - stamps[old]) / NS_PER_S,
            )
        )
    return tuple(found)


def frames_off(
    sightings: tuple[Sighting, ...], imu: ImuSamples | None, crane: CraneSamples | None,
    rectifier: Rectifier, shift_ns: int,
) -> int:  # fmt: skip
    """Estimate by how many frames the cameras' stamps are late against gyro and encoders; 0 where that isn't
    clear.

    The turns and distances that the pictures show between neighbouring frames are compared with those that
    the other sensors show between neighbours some frames later or earlier. The gyro's bias is fitted each
    time.
    """
    most = MAX_FRAMES_OFF if len(sightings) > 2 * MAX_FRAMES_OFF + MANY_STEPS else 1
    offs = tuple(range(-most, most + 1))
    cost, worst = {}, {}
    for off, steps in zip(offs, compare_steps(sightings, imu, crane, rectifier, shift_ns, offs), strict=True):
        turn_residual = _gyro_residual(steps)
        travelled = np.isfinite(steps.travel)
        terms = []
        if len(turn_residual) >= MIN_STEPS:
            terms.append(float((turn_residual**2).mean()) / TURN_SIGMA_RAD**2)
        if travelled.sum() >= MIN_STEPS:
            wrong = (steps.travel - steps.way)[travelled]
            terms.append(float((wrong**2).mean()) / WAY_SIGMA_M**2)
        cost[off], worst[off] = (float(np.mean(terms)), max(terms)) if terms else (0.0, 0.0)
    best = min(cost, key=lambda off: cost[off])
    clear = cost[best] < CLEARLY_BETTER * cost[0] and cost[0] > 1 / CLEARLY_BETTER
    # If only the stamps are late, all sensors agree once these are shifted back.
    return -best if clear and worst[best] < 1 / CLEARLY_BETTER else 0


def _gyro_residual(steps: StepComparison) -> Float64:
    """Subtract from the gyro's turns (K, 3) those of the pictures and the constant rate that fits best."""
    known = np.isfinite(steps.gyro).all(axis=1)
    time = steps.seconds[known, None]
    off = steps.gyro[known] - steps.turn[known]
    residual: Float64 = off - time * (time * off).sum(axis=0) / max(float((time**2).sum()), 1e-12)
    return residual


def _chosen(crane: CraneSamples, kept: Bool) -> CraneSamples:
    return replace(crane, stamp_ns=crane.stamp_ns[kept], position_m=crane.position_m[kept])


def frozen_stretches(crane: CraneSamples) -> list[Stretch]:
    """Find stretches of equal readings during which a moving crane must have travelled on, or after which the
    readings continue elsewhere: of all encoders together, or of any one.

    A crane that reverses gives equal readings too, above all with coarse encoders, but stays near them. One
    axis often stops while another travels on.
    """
    return merge_stretches(
        (first, last, axes) for axes in ((0, 1, 2), (0,), (1,), (2,)) for first, last in _frozen(crane, axes)
    )


def merge_stretches(stretches: Iterable[Stretch]) -> list[Stretch]:
    """Merge stretches that overlap. The axes are those that are frozen last, if in doubt the fewer."""
    found: list[Stretch] = []
    for first, last, axes in sorted(stretches):
        if found and first <= found[-1][1]:
            longer = max(found[-1], (first, last, axes), key=lambda part: (part[1], -len(part[2])))
            found[-1] = found[-1][0], longer[1], longer[2]
        else:
            found.append((first, last, axes))
    return found


def frozen_now(crane: CraneSamples) -> Bool:
    """Check which encoders (3,) stand frozen at the last reading: each by itself, else all together."""
    last = len(crane.stamp_ns) - 1

    def is_frozen(*axes: int) -> bool:
        return any(end == last for _, end in _frozen(crane, axes))

    each = np.array([is_frozen(axis) for axis in range(3)])
    return each if each.any() else np.full(3, is_frozen(0, 1, 2))


def _frozen(crane: CraneSamples, axes: tuple[int, ...]) -> list[tuple[int, int]]:
    """Find stretches (first, last) of equal readings of encoders `axes` that must have moved: all of them, or
    one.
    """
    time, min_m = (crane.stamp_ns - crane.stamp_ns[:1]) / NS_PER_S, min_way_m(crane)
    # The difference of two rounded readings of each is off by up to a step.
    unsure_m = max(SPEED_SIGMAS * min_m / HELD_SIGMAS, len(axes) ** 0.5 * crane.resolution_m)
    place = crane.position_m[:, list(axes)]
    braking = MAX_ALONE_MPS2[axes[0]] if len(axes) == 1 else MAX_BRAKING_MPS2
    same = np.r_[False, (np.diff(place, axis=0) == 0).all(axis=1), False]
    edges = np.flatnonzero(np.diff(same.astype(int)))
    found = []
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first + 1 < MIN_FROZEN or first < SIDE // 2:
            continue
        after = place[last + 1 : last + 4]
        # Two of the three may be wild.
        away = float(np.linalg.norm(after - place[last], axis=1).min()) if len(after) == 3 else 0.0
        away -= braking * float(time[min(last + 2, len(time) - 1)] - time[last]) ** 2 / 2
        speed = _speed_before(place, time, int(first), unsure_m)
        braked = min(float(time[last] - time[first]), speed / braking)
        if max(away, (speed - braking * braked / 2) * braked) > min_m:
            found.append((int(first), int(last)))
    return found


def _speed_before(place: Float64, time: Float64, first: int, unsure_m: float) -> float:
    """Extrapolate the speed (m/s) at a reading from the readings before it, less what their error may add.

    It continues the medians of the earlier and the later rates over half a window, since a braking crane is
    slower than it was, and is at most that of the last steps.
    """
    begin = min(int(np.searchsorted(time, time[first] - SPEED_WINDOW_S)), max(0, first - SIDE))
    half = (first - begin + 1) // 2
    old, new = slice(begin, first + 1 - half), slice(begin + half, first + 1)
    rates, at = (place[new] - place[old]) / (time[new] - time[old])[:, None], (time[new] + time[old]) / 2
    parts = (slice(0, (len(at) + 1) // 2), slice(len(at) // 2, None))
    earlier, later = (np.median(rates[part], axis=0) for part in parts)
    apart = float(at[parts[1]].mean() - at[parts[0]].mean())
    drawn_on = (time[first] - at[parts[1]].mean()) / apart if apart > 0 else 0.0
    speed = float(np.linalg.norm(later + drawn_on * (later - earlier)))
    near = int(np.searchsorted(time, time[first] - STOP_WINDOW_S))
    # The third, since two may be wild.
    last = np.array([min(first - 1, near), min(first - 3, near)])
    steps = np.linalg.norm(place[first] - place[last], axis=1) / (time[first] - time[last])
    unsure = unsure_m / float(np.median(time[new] - time[old]))
    return max(0.0, min(speed, float(steps.min())) - unsure)
