"""Widen the poses that were given out before a fault of the encoders was known, and describe its scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame
from barsight.core.stamps import NS_PER_S
from barsight.motion.batch.encoder_scale import possible_scales, suspected_scales
from barsight.motion.fixed_lag.sliding_window import Window
from barsight.motion.problem.encoder_factors import scale_excess, scale_sentences
from barsight.motion.problem.travel import widen_positions


def widened(frames: Sequence[PosedFrame], off_m: Float64) -> tuple[PosedFrame, ...]:
    """Add the squares of errors (F, 3), each as one along its direction, to the positions' covariances."""
    return tuple(
        replace(frame, covariance=widen_positions(frame.covariance, off))
        for frame, off in zip(frames, off_m, strict=True)
    )


def way_of_delay(crane: CraneSamples, stamp_ns: Int64, late_ns: int, found_ns: int) -> Float64:
    """Compute by how much (F, 3) readings are off that are late by `late_ns`; nothing from `found_ns` on."""
    if not (late_ns and len(crane.stamp_ns)):
        return np.zeros((len(stamp_ns), 3))
    begin_ns = crane.stamp_ns[0]

    def place_at(stamps: Int64) -> Float64:
        time, at = (crane.stamp_ns - begin_ns) / NS_PER_S, (stamps - begin_ns) / NS_PER_S
        return np.column_stack([np.interp(at, time, axis) for axis in crane.position_m.T])

    off = place_at(stamp_ns + late_ns) - place_at(stamp_ns)
    return np.where((stamp_ns < found_ns)[:, None], off, 0.0)


def widened_by_scales(
    frames: tuple[PosedFrame, ...], stamp_ns: Int64, window: Window | None, scaled_ns: int | None
) -> tuple[PosedFrame, ...]:
    """Widen frames by what the encoders' scales shift them, known or suspected by now; those from `scaled_ns`
    on were estimated with them.
    """
    if window is None or window.scales is None or window.problem.travel is None:
        return frames
    problem, scales, travel = window.problem, window.scales, window.problem.travel
    value, at = scales.value.copy(), [problem.scaled.index(axis) for axis in problem.held]
    value[at] = possible_scales(problem, problem.held, scales.chosen(at)) if at else 0.0
    place = np.array([frame.reference_from_body.translation for frame in frames])
    shift = travel.shifts(problem.scaled, value, place)
    if scaled_ns is not None:
        shift[stamp_ns >= scaled_ns] = 0.0
    return widened(frames, shift)


def live_scale_sentences(
    window: Window | None, scaled_ns: int | None, begin_ns: int
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Describe the scales that are no longer taken as right (whichever is wrong, poses before are off), and
    those that are but are suspected.
    """
    if window is None or window.scales is None or window.problem.travel is None:
        return (), ()
    problem, scales = window.problem, window.scales
    if scaled_ns is None:
        suspected = suspected_scales(problem, problem.scaled, scales)
        return (), scale_sentences(*suspected)[1]
    at = [k for k, axis in enumerate(problem.scaled) if axis not in problem.held]
    since = f" from {(scaled_ns - begin_ns) / NS_PER_S:.1f} s on; poses before may be off by it"
    axes = [problem.scaled[k] for k in at]
    sure, maybe = scale_sentences(axes, scale_excess(problem, scales).chosen(at), since)
    return sure + maybe, ()
