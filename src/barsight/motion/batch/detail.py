"""Report what a trajectory rests on: details of its frames, and what was left out or joined."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.motion_detail import InertialStates, MotionDetail, NormalisedResiduals, RelativePoses
from barsight.core.records.pairs import RefusedFrame
from barsight.core.records.sensor_samples import CraneSamples
from barsight.motion.frontend.chains import chain_begins, seconds_after
from barsight.motion.frontend.sightings import Sighting, innovations
from barsight.motion.problem.nodes import Nodes

if TYPE_CHECKING:
    from barsight.motion.batch.bundle_adjustment import Estimate


def jumps_alone(crane: CraneSamples | None) -> tuple[str, ...]:
    """Describe the encoders' jumps where no estimate from all sensors determines them."""
    from barsight.motion.problem.encoder_factors import jump_sentences

    if crane is None:
        return ()
    sure, maybe = jump_sentences(crane.jumps, int(crane.stamp_ns[0]), None)
    return sure + maybe


def select_detail(
    estimate: Estimate,
    sightings: tuple[Sighting, ...],
    nodes: Nodes,
    encoders: NormalisedResiduals | None,
    shift: int,
) -> MotionDetail:
    """Select the details, stamped by cam0's clock; of an estimate by nodes, those of the frames alone."""
    inertial = estimate.inertial
    if inertial is not None:
        values = {f.name: getattr(inertial, f.name)[nodes.frame] for f in fields(inertial)}
        inertial = InertialStates(**{**values, "stamp_ns": values["stamp_ns"] - shift})
    seen = {sighting.stamp_ns: sighting.ambiguous for sighting in sightings}
    shown = np.flatnonzero(estimate.points)
    ambiguous = [seen.get(int(stamp) - shift, 0) for stamp in nodes.stamp_ns[shown]]
    points = np.column_stack([estimate.points[shown], np.array(ambiguous, np.int64)])
    by_frames = [
        None if part is None else replace(part, stamp_ns=part.stamp_ns - shift)
        for part in (estimate.pictures, estimate.imu, encoders)
    ]
    return MotionDetail(
        inertial, by_frames[0], by_frames[1], by_frames[2], points, RelativePoses(estimate.relative),
        innovations(sightings),
    )  # fmt: skip


def untied_pictures(
    sightings: tuple[Sighting, ...], refused: tuple[RefusedFrame, ...]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Warn that pictures don't follow from each other, even where encoders place their frames: as warnings
    for up to half of the frames, else as doubts. Right pictures that contradict the left ones explain it, and
    are told as that (`rig_moved`).
    """
    if any(one.sides_apart for one in sightings):
        return (), ()
    count = len(refused) + sum(one.motion is None and one.again is None for one in sightings[1:])
    if count == 0:
        return (), ()
    total = len(sightings) + len(refused)
    problem = f"the pictures of {count} of {total} frames can't be tied to those before"
    if 2 * count <= total:
        return (problem,), ()
    return (), (
        f"{problem}: too little texture, too long a step, or left and right pictures of different times",
    )


def joint_sentences(sightings: tuple[Sighting, ...], relative: Float64) -> tuple[str, ...]:
    """Describe where the pictures begin anew and what joins the two parts, with its sigma; relative
    (K - 1, 6, 6).
    """
    sentences = []
    for k, again in chain_begins(sightings):
        turn, shift = np.sqrt(np.diag(relative[k - 1]).reshape(2, 3).sum(axis=1))
        at = seconds_after(sightings[k].stamp_ns, sightings[0].stamp_ns)
        sentences.append(
            f"the pictures begin anew at {at}; {'a place seen again' if again else 'the IMU'} joins both "
            f"parts, 1 sigma {1e3 * shift:.1f} mm and {np.degrees(turn):.3f} degrees"
        )
    return tuple(sentences)
