"""Summarize a run: latencies of poses, tiles and lifts from the exposure, and where frames were lost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from barsight.core.stamps import NS_PER_S
from barsight.live.link import Link
from barsight.live.shared.counters import Counters

LOST = (
    "unpaired_cam0", "unpaired_cam1", "torn", "capture_down", "incomplete", "missed", "backpressure", "late",
    "clock", "trigger",
)  # fmt: skip
"""Causes by which capture counts lost pictures: no partner; damaged; due while capture was down; packets
missing; all packets missing; the host too slow; out of order; while a camera's clock settles; a trigger
number that contradicts the stamps.
"""


def latencies(link: Link, board: Counters, lifts_s: float | None) -> dict[str, Any]:
    """Build the content of latency.json. lifts_s: from the last frame's exposure to the lifts, if any.

    Latency of a pose: from its stamp until it is written (none at full speed); of a pair: from its exposure
    to its pose from pictures; of a tile: from its keyframe's exposure until the keyframe is fused, without
    those that are fused only at the end.
    """
    poses = [late for _, late in link.outputs().read()]
    pairs = [done - exposed for _, exposed, done, _, has_pose in link.frames().read() if has_pose]
    tiles = [done - exposed for _, exposed, done in link.tiles().read()]
    return {
        "schema_version": 1,
        "speed": link.source.speed,
        "pose_s": spread([ns / NS_PER_S for ns in poses]),
        "pair_s": spread([ns / NS_PER_S for ns in pairs]),
        "tile_s": spread([ns / NS_PER_S for ns in tiles]),
        "lifts_s": spread([] if lifts_s is None else [lifts_s]),
        "frames": counts(board),
    }


def spread(seconds: Sequence[float]) -> dict[str, Any]:
    """Count and summarize durations: n, p50, p99, max; null without durations."""
    if not seconds:
        return {"n": 0, "p50": None, "p99": None, "max": None}
    low, high = np.percentile(seconds, (50, 99)).tolist()
    return {"n": len(seconds), "p50": round(low, 4), "p99": round(high, 4), "max": round(max(seconds), 4)}


def counts(board: Counters) -> dict[str, Any]:
    """Count frames by stage, and those lost by cause. captured: pairs, and pictures without a partner.

    Pictures that were damaged, or due while capture was down, are counted individually.
    """
    capture, track, built = (board.row(role) for role in ("capture", "track", "map"))
    dropped = {cause: capture[cause] for cause in LOST}
    lost = sum(dropped.values())
    dropped |= {name: track[name] for name in ("newer_pair", "not_placed")}
    tracked_or_told = sum(track[name] for name in ("tracked", "kept_passed", "newer_pair", "not_placed"))
    dropped["track_down"] = max(track["taken"] - tracked_or_told, 0)
    return {
        "captured": capture["paired"] + lost,
        "paired": capture["paired"],
        "tracked": track["tracked"],
        "kept": track["kept"],
        "mapped": built["mapped"],
        "kept_without_pose": track["kept_passed"],
        "dropped": dropped,
    }
