"""Find jumps of the encoders and subtract them; `jump_window` defines a jump."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.linalg.dense import one_blas_thread
from barsight.core.linalg.robust import mad_sigma
from barsight.core.records.sensor_samples import CraneSamples, EncoderJump
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.motion.crane.jump_window import (
    HALF_S,
    MAX_RATE_HZ,
    MAYBE_SIGMAS,
    MIN_SIDE,
    STRIDE_S,
    SURE_SIGMAS,
    WIDE_M,
    FoundStep,
    JumpWindow,
)
from barsight.motion.crane.known_motion import KnownMotion
from barsight.motion.crane.springs import find_springs, with_springs

MIN_FOR_NOISE = 20
"""Minimum number of readings from which their noise is estimated."""
MIN_COUNTS = 0.8
"""Minimum size of a jump in steps of its encoder's resolution, since counts are lost as a whole."""
REACH_S = 0.5
"""Maximum distance, s, of a jump from the step by which it was found."""
FAST_RATIO = 0.5
"""Speed, as a ratio of the fastest axis's, from which stamps that jitter show in the readings."""


@one_blas_thread()
def find_jumps(
    crane: CraneSamples, known: KnownMotion | None = None, first_ns: int | None = None
) -> tuple[EncoderJump, ...]:
    """Find jumps in the readings; those that `crane` lists already are allowed for within their sigma.

    first_ns: steps before this stamp aren't sought. A jump that isn't certain is returned with size 0 and its
    measured size as sigma.
    """
    series = _thinned(crane)
    if len(series.stamp_ns) <= 2 * MIN_SIDE:
        return ()
    known, sigma_m = known or KnownMotion(), _noise_m(crane, series)
    stride = seconds_to_ns(STRIDE_S)
    middles = np.arange(series.stamp_ns[0], series.stamp_ns[-1] + 1, stride)
    if first_ns is not None:
        middles = middles[middles >= first_ns - stride // 2]
    around = {m: JumpWindow.around(series, sigma_m, m, known) for m in middles.tolist()}
    windows = {m: window for m, window in around.items() if window is not None and window.beyond.size}
    jumps = [[jump for jump in crane.jumps if jump.axis == axis] for axis in range(3)]
    steps = {(m, axis): windows[m].largest_step(axis, jumps[axis]) for m in windows for axis in range(3)}
    if not any(steps.values()):
        return ()
    springs = find_springs(list(windows.values()), jumps)
    sprung = {m: with_springs(window, springs) for m, window in windows.items()}
    min_jump_m = MIN_COUNTS * crane.resolution_m

    def largest_step(m: int, axis: int, step: FoundStep | None) -> FoundStep | None:
        """Find the largest step beside the oscillations. They only explain `step`, found without them: one
        that isn't there without them is what is left of a wild reading that was taken for an oscillation.
        """
        found = step and sprung[m].largest_step(axis, jumps[axis])
        return found if found is not None and abs(found.size_m) > min_jump_m else None

    steps = {(m, axis): largest_step(m, axis, step) for (m, axis), step in steps.items()}
    found: list[EncoderJump] = []
    while candidates := [step for step in steps.values() if step is not None]:
        best = max(candidates, key=lambda step: step.sigmas)
        middle, axis = int(series.stamp_ns[best.reading]), best.axis
        around_it = JumpWindow.around(series, sigma_m, middle, known, reach_s=REACH_S)
        if around_it is not None:  # a large jump just outside a window's steps seems to be at one of them
            best = with_springs(around_it, springs).largest_step(axis, jumps[axis]) or best
        stamp = _exact_stamp(crane, series, best)
        if best.sigmas > SURE_SIGMAS:
            found.append(EncoderJump(stamp, axis, best.size_m, WIDE_M, found_sigma_m=best.sigma_m))
        else:
            found.append(EncoderJump(stamp, axis, 0.0, abs(best.size_m), "maybe"))
        jumps[axis].append(found[-1])
        for m in windows:
            if abs(m - stamp) < seconds_to_ns(HALF_S) + stride:
                steps[m, axis] = largest_step(m, axis, windows[m].largest_step(axis, jumps[axis]))
    return tuple(found)


@one_blas_thread()
def lost_counts(
    crane: CraneSamples, after: Iterable[EncoderJump], known: KnownMotion | None, min_way_m: float
) -> tuple[EncoderJump, ...]:
    """Select from the possible jumps after freezes those that are seen and those that could go unnoticed.

    An encoder that loses count misses the travel during the freeze, `min_way_m` or more; one that reads
    absolute positions continues at the right one.
    """
    series, lost = _thinned(crane), []
    known, sigma_m = known or KnownMotion(), _noise_m(crane, series)
    for jump in after:
        following = int(np.searchsorted(crane.stamp_ns, jump.stamp_ns))
        if following == 0:
            continue
        gap_ns = jump.stamp_ns - int(crane.stamp_ns[following - 1])
        half_s = HALF_S + gap_ns / 2 / NS_PER_S
        window = JumpWindow.around(series, sigma_m, jump.stamp_ns - gap_ns // 2, known, half_s)
        if window is None:
            lost.append(jump)
            continue
        size, sigma = window.step_at(jump.axis, jump.stamp_ns)
        read = crane.position_m[:, jump.axis]
        net = abs(float(np.median(read[following : following + 3]) - np.median(read[:following][-3:])) - size)
        if abs(size) > MAYBE_SIGMAS * sigma:
            lost.append(replace(jump, size_m=size))
        elif min_way_m < net < MAYBE_SIGMAS * sigma:
            lost.append(jump)
    return tuple(lost)


def take_off_jumps(crane: CraneSamples, jumps: Iterable[EncoderJump]) -> CraneSamples:
    """Subtract jumps from the readings after each of them. Which side is right can't be told, so the crane's
    first readings are taken as right.
    """
    place, jumps = crane.position_m.copy(), tuple(sorted(jumps, key=lambda jump: jump.stamp_ns))
    for jump in jumps:
        place[:, jump.axis] -= jump.size_m * jump.share(crane.stamp_ns)
    return replace(crane, position_m=place, jumps=jumps)


def _exact_stamp(crane: CraneSamples, series: CraneSamples, step: FoundStep) -> int:
    """Find the stamp of the first reading beyond a step, among all original readings near it."""
    count = len(step.way_m)
    stamps = series.stamp_ns[step.first : step.first + count]
    position_m = series.position_m[step.first : step.first + count, step.axis] + step.way_m
    k = step.reading - step.first
    if len(series.stamp_ns) == len(crane.stamp_ns):
        return int(stamps[k])
    begin, end = np.searchsorted(crane.stamp_ns, (stamps[k - 2], stamps[k + 1]))
    near = crane.stamp_ns[begin : end + 1]
    off = crane.position_m[begin : end + 1, step.axis] - np.interp(
        (near - stamps[0]) / NS_PER_S, (stamps - stamps[0]) / NS_PER_S, position_m
    )
    before, after = np.abs(off), np.abs(off - step.size_m)
    cost = np.concatenate([[0.0], np.cumsum(before)]) + np.concatenate([np.cumsum(after[::-1])[::-1], [0.0]])
    return int(near[min(int(cost.argmin()), len(near) - 1)])


def _thinned(crane: CraneSamples) -> CraneSamples:
    """Combine readings that come faster than `MAX_RATE_HZ` by their median on each axis."""
    spacing = float(np.median(np.diff(crane.stamp_ns))) if len(crane.stamp_ns) > 1 else np.inf
    together = round(NS_PER_S / MAX_RATE_HZ / spacing)
    if together < 2:
        return crane
    named = (crane.stamp_ns - crane.stamp_ns[0]) // round(together * spacing)
    parts = np.split(np.arange(len(named)), np.flatnonzero(np.diff(named)) + 1)
    stamps = np.array(
        [crane.stamp_ns[0] + int((crane.stamp_ns[p] - crane.stamp_ns[0]).mean()) for p in parts]
    )
    place = np.array([np.median(crane.position_m[p], axis=0) for p in parts])
    return replace(crane, stamp_ns=stamps, position_m=place)


def _noise_m(crane: CraneSamples, series: CraneSamples) -> Float64:
    """Estimate the sigma (n, 3) of the series' readings, m: noise s, and stamps that jitter by j at speed v,

        sigma^2 = s^2 + j^2 v^2

    s is the stated noise, or that of the slower readings where it is larger; j explains what the faster ones
    add to it.
    """
    together = len(crane.stamp_ns) / max(len(series.stamp_ns), 1)
    stated = crane.position_std_m * (1.0 if together < 1.5 else (np.pi / 2 / together) ** 0.5)
    if len(series.stamp_ns) < MIN_FOR_NOISE:
        return np.full((len(series.stamp_ns), 3), stated)
    off, speed = _scatter_m(series), np.abs(_speed_mps(series))
    inner = speed[2:-2]
    fast = inner > FAST_RATIO * np.percentile(inner, 95, axis=0).max()
    slow = [off[~fast[:, k], k] for k in range(3)]
    noise = max([stated, *(float(mad_sigma(part, axis=0)) for part in slow if len(part) >= MIN_FOR_NOISE)])
    if np.count_nonzero(fast) < MIN_FOR_NOISE:
        return np.full((len(series.stamp_ns), 3), noise)
    jitter_s = np.sqrt(max(0.0, float(mad_sigma(off[fast], axis=0)) ** 2 - noise**2)) / np.median(inner[fast])
    return np.asarray(np.hypot(noise, jitter_s * speed))


def _speed_mps(crane: CraneSamples) -> Float64:
    """Compute the speed (n, 3) at the readings as their slope over five of them."""
    at = np.arange(len(crane.stamp_ns))
    old, new = np.maximum(at - 2, 0), np.minimum(at + 2, len(at) - 1)
    seconds = (crane.stamp_ns[new] - crane.stamp_ns[old]) / NS_PER_S
    return np.asarray((crane.position_m[new] - crane.position_m[old]) / seconds[:, None])


def _scatter_m(crane: CraneSamples) -> Float64:
    """Compute the distance (n - 4, 3) of each reading to the cubic through the two readings on either side,
    scaled to the noise of one reading.
    """
    time = (crane.stamp_ns - crane.stamp_ns[:1]) / NS_PER_S
    around = np.arange(2, len(time) - 2)[:, None] + np.array([-2, -1, 1, 2])
    unit = (time[around] - time[2:-2, None]) / float(np.median(np.diff(time)))
    weights = np.ones_like(unit)  # of Lagrange interpolation at the reading's own time
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[:, i] *= -unit[:, j] / (unit[:, i] - unit[:, j])
    off = crane.position_m[2:-2] - np.einsum("kn,knj->kj", weights, crane.position_m[around])
    return np.asarray(off / np.sqrt(1 + (weights**2).sum(axis=1))[:, None])
