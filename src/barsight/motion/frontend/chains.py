"""Join chains of sightings: after a loss the pictures begin anew, and the two parts can't always be tied."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from barsight.core.arrays import Int64
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.features.guided_matching import PredictedMotion
from barsight.motion.crane.sway import MAX_GAP_S
from barsight.motion.frontend.sightings import Sighting

UNTIED = "the pictures begin anew, and nothing ties them to the part that is placed"
"""Reason given for frames that show enough points but can't be placed."""


def untied_sentence(count: int) -> str:
    """Describe how many frames were left out because nothing ties them to the others."""
    return f"the pictures begin anew and nothing joins the parts: {count} frames are left out"


def tied_parts(sightings: Sequence[Sighting], bridged: Callable[[int, int], bool]) -> Int64:
    """Number the part (K,) that each sighting belongs to; sightings of one part are tied by pictures, or
    `bridged` from one stamp to the next.
    """
    part = np.arange(len(sightings))
    for k in range(1, len(sightings)):
        for old in _ties(sightings, k):
            part[part == part[k]] = part[old]
        if sightings[k].motion is None and bridged(sightings[k - 1].stamp_ns, sightings[k].stamp_ns):
            part[part == part[k]] = part[k - 1]
    return part


def imu_bridges(imu: ImuSamples | None, shift_ns: int) -> Callable[[int, int], bool]:
    """Return a check of whether the IMU covers the time between two frames without a gap."""

    def bridges(old_ns: int, new_ns: int) -> bool:
        if imu is None:
            return False
        first, end = np.searchsorted(imu.stamp_ns, (old_ns + shift_ns, new_ns + shift_ns))
        stamps = imu.stamp_ns[max(0, int(first) - 1) : int(end) + 1]
        if len(stamps) < 2 or stamps[0] > old_ns + shift_ns or stamps[-1] < new_ns + shift_ns:
            return False
        return bool(np.diff(stamps).max() <= seconds_to_ns(MAX_GAP_S))

    return bridges


def chained_poses(sightings: Sequence[Sighting], first: Pose, body_from_rect0: Pose) -> list[Pose]:
    """Chain the body's poses from the first on; where pictures tie nothing, the last motion is continued."""
    mount, back = body_from_rect0, body_from_rect0.inverse()
    steps: list[list[tuple[int, Pose]]] = [[] for _ in sightings]
    for k in range(1, len(sightings)):
        for old, motion in _ties(sightings, k).items():
            moved = mount @ Pose("rect0", "rect0", motion.rotation, motion.translation) @ back
            steps[old].append((k, moved.inverse()))
            steps[k].append((old, moved))
    poses: dict[int, Pose] = {}
    for k in range(len(sightings)):
        if k in poses:
            continue
        poses[k] = _gone_on(sightings, poses, k) if k else first
        reached = [k]
        while reached:
            old = reached.pop()
            for new, step in steps[old]:
                if new not in poses:
                    poses[new] = poses[old] @ step
                    reached.append(new)
    return [poses[k] for k in range(len(sightings))]


def _ties(sightings: Sequence[Sighting], k: int) -> dict[int, PredictedMotion]:
    """Return the earlier sightings to which pictures tie one, with the motion since each."""
    seen, ties = sightings[k], dict[int, PredictedMotion]()
    if seen.motion is not None:
        ties[k - 1] = seen.motion
    if seen.again is not None:
        stamps = [one.stamp_ns for one in sightings[:k]]
        if seen.again.stamp_ns in stamps:
            ties[stamps.index(seen.again.stamp_ns)] = seen.again.motion
    return ties


def _gone_on(sightings: Sequence[Sighting], poses: dict[int, Pose], k: int) -> Pose:
    last = poses[k - 1]
    if k < 2 or sightings[k - 1].motion is None:
        return last
    before, now, next_ = (sightings[j].stamp_ns for j in (k - 2, k - 1, k))
    way = (last.translation - poses[k - 2].translation) * ((next_ - now) / max(now - before, 1))
    return Pose(last.target, last.source, last.rotation, last.translation + way)


def chain_begins(sightings: Sequence[Sighting]) -> list[tuple[int, bool]]:
    """List the sightings at which chains begin anew, and whether points seen again tie that chain to
    others.
    """
    begins = [k for k in range(1, len(sightings)) if sightings[k].motion is None]
    ends = [*begins, len(sightings)][1:]
    return [
        (k, any(one.again is not None for one in sightings[k:end]))
        for k, end in zip(begins, ends, strict=True)
    ]


def seconds_after(stamp_ns: int, begin_ns: int) -> str:
    """Format a time for messages."""
    return f"{(stamp_ns - begin_ns) / NS_PER_S:.1f} s"
