"""Match pairs in chains: the first of each from nothing, the others from the disparity of the one before."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from threading import Lock

import numpy as np

from barsight.checkpoint import checkpointed
from barsight.core.pose import Pose
from barsight.core.stamps import NS_PER_S, interpolate_at
from barsight.core.types import RectifiedPair, RefusedFrame
from barsight.mapping.view import MatchedFrame, Matcher, Preceding
from barsight.measurement import Refusal
from barsight.recording.rectified_pairs import RectifiedPairs

_MAX_READING_AGE_NS = NS_PER_S // 2
"""A place between readings further apart than this is not known. A session has them all by then."""


class PairChain:
    """Matches the pairs of `pairs`, each once for all runs that keep checkpoints in `checkpoints`.

    Results depend on the recording alone, not on which pairs are asked for or in what order: a pair whose
    predecessor wasn't asked for matches that one too. A chain begins every `length` pairs, and where encoders
    don't say how the camera moved. Several threads may ask at once.
    """

    def __init__(
        self, pairs: RectifiedPairs, matcher: Matcher, length: int, checkpoints: Path | None
    ) -> None:
        self._pairs, self._matcher, self.length, self._checkpoints = pairs, matcher, length, checkpoints
        self._turns: dict[int, Lock] = {}
        self._last: dict[int, tuple[int, MatchedFrame | Refusal]] = {}

    def __call__(self, pair: RectifiedPair | RefusedFrame) -> MatchedFrame | Refusal:
        """Match a pair of the recording."""
        if self.length == 1:
            return self._matched(pair, None)
        place = self._place(pair.stamp_ns)
        chain = place // self.length
        with self._turns.setdefault(chain, Lock()):
            frame = self._at(pair, place)
            for done in [number for number in list(self._last) if number < chain - 1]:
                self._last.pop(done, None)
                self._turns.pop(done, None)
            return frame

    def match_all(self, pairs: Sequence[RectifiedPair | RefusedFrame]) -> list[MatchedFrame | Refusal]:
        """Match pairs one after the other."""
        return [self(pair) for pair in pairs]

    def split(
        self, pairs: Iterable[RectifiedPair | RefusedFrame]
    ) -> Iterator[list[RectifiedPair | RefusedFrame]]:
        """Split pairs in time's order into those of each chain, which can be matched side by side."""
        for _, together in groupby(pairs, lambda pair: self.chain(pair.stamp_ns)):
            yield list(together)

    def chain(self, stamp_ns: int) -> int:
        """Number the chain that a pair is of: chains can be matched side by side."""
        return self._place(stamp_ns) // self.length

    def _place(self, stamp_ns: int) -> int:
        return bisect_left(self._pairs.recording.index.stamps_ns, stamp_ns)

    def _at(self, pair: RectifiedPair | RefusedFrame, place: int) -> MatchedFrame | Refusal:
        chain = place // self.length
        at, frame = self._last.get(chain, (-1, None))
        if at == place and frame is not None:
            return frame
        if place % self.length == 0:
            frame = None
        elif at != place - 1:
            stamp = self._pairs.recording.index.stamps_ns[place - 1]
            frame = self._at(next(self._pairs({stamp})), place - 1)
        found = self._matched(pair, frame)
        self._last[chain] = place, found
        return found

    def _matched(
        self, pair: RectifiedPair | RefusedFrame, before: MatchedFrame | Refusal | None
    ) -> MatchedFrame | Refusal:
        if isinstance(pair, RefusedFrame):
            return Refusal("recording", pair)

        def match() -> MatchedFrame:
            known = before if isinstance(before, MatchedFrame) else None
            guess = None if known is None else self._motion(known.stamp_ns, pair.stamp_ns)
            if known is None or guess is None:
                return self._matcher(pair)
            return self._matcher(pair, Preceding(known, guess))

        return checkpointed(self._checkpoints, f"matched_{pair.stamp_ns}", match)

    def _motion(self, before_ns: int, now_ns: int) -> Pose | None:
        """Predict now_from_before of the rectified left camera by the encoders, at the nominal attitude; None
        where they don't say.
        """
        recording = self._pairs.recording
        crane = recording.crane()
        if crane is None or crane.stamp_ns.size == 0:
            return None
        at = np.array([before_ns, now_ns], dtype=np.int64) + recording.rig.timeshift_cam_imu_ns
        places = interpolate_at(at, crane.stamp_ns, crane.position_m)
        after = np.minimum(np.searchsorted(crane.stamp_ns, at), crane.stamp_ns.size - 1)
        age = np.maximum(crane.stamp_ns[after] - at, at - crane.stamp_ns[np.maximum(after - 1, 0)])
        if not np.isfinite(places).all() or age.max() > _MAX_READING_AGE_NS:
            return None
        shift = crane.yard_from_body_nominal.T @ (places[0] - places[1])
        mount = self._pairs.rectifier.body_from_rect0
        moved = mount.inverse() @ Pose(mount.target, mount.target, np.eye(3), shift) @ mount
        return Pose("now", "before", moved.rotation, moved.translation)
