"""Match pairs in chains: the first of each from nothing, the others from the disparity of the one before."""

from __future__ import annotations

import hashlib
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from threading import Lock

import numpy as np

from barsight.core.parallel import WORKERS
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedPair, RefusedFrame
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.stamps import NS_PER_S, interpolate_at
from barsight.mapping.view import MatchedFrame, Matcher, Preceding
from barsight.measurement import Refusal
from barsight.reconstruction.checkpoint import checkpointed
from barsight.recording.rectified_pairs import RectifiedPairs

_MAX_READING_AGE_NS = NS_PER_S // 2
"""A place between readings further apart than this is not known. A session has them all by then."""


@dataclass(frozen=True, eq=False)
class _Step:
    """A pair of a chain. now_from_before: how the rectified left camera moved since the pair before, by the
    encoders; None at the chain's beginning and where they don't say. name: tells all that its match rests on
    beside the pictures.
    """

    stamp_ns: int
    now_from_before: Pose | None
    name: str


class PairChain:
    """Matches the pairs of `pairs`, each once for all runs that keep checkpoints in `checkpoints`.

    Results depend on the recording alone, not on which pairs are asked for or in what order: a pair whose
    predecessor wasn't asked for matches that one too. A chain begins every `length` pairs, and where encoders
    don't say how the camera moved. Several threads may ask at once. Of a recording that grows, `holds` tells
    which results still stand.
    """

    def __init__(
        self, pairs: RectifiedPairs, matcher: Matcher, length: int, checkpoints: Path | None
    ) -> None:
        self._pairs, self._matcher, self.length, self._checkpoints = pairs, matcher, length, checkpoints
        self._turns: dict[int, Lock] = {}
        self._last: dict[int, tuple[str, MatchedFrame | Refusal]] = {}
        self._names: dict[int, str] = {}

    def __call__(self, pair: RectifiedPair | RefusedFrame) -> MatchedFrame | Refusal:
        """Match a pair of the recording."""
        steps = self._steps(pair.stamp_ns)
        self._names[pair.stamp_ns] = steps[-1].name
        if self.length == 1:
            return self._matched(pair, steps[-1], None)
        chain = self.chain(pair.stamp_ns)
        with self._turns.setdefault(chain, Lock()):
            frame = self._at(pair, steps, chain)
            for done in [number for number in list(self._last) if number < chain - 1]:
                self._last.pop(done, None)
                self._turns.pop(done, None)
            return frame

    def holds(self, stamp_ns: int) -> bool:
        """Tell whether a pair was matched as it would be with the readings that there are now."""
        return self._names.get(stamp_ns) == self._steps(stamp_ns)[-1].name

    def follows(self, stamp_ns: int) -> bool:
        """Tell whether a pair is held against the one before: it begins no chain, encoders say the way."""
        return self._steps(stamp_ns)[-1].now_from_before is not None

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

    def _steps(self, stamp_ns: int) -> list[_Step]:
        """List the pairs of a chain up to one of them."""
        stamps, crane = self._pairs.recording.index.stamps_ns, self._pairs.recording.crane()
        place = self._place(stamp_ns)
        first = place - place % self.length
        steps = [_Step(stamps[first], None, f"matched_{stamps[first]}")]
        for before_ns, now_ns in pairwise(stamps[first : place + 1]):
            moved, name = self._motion(before_ns, now_ns, crane), f"matched_{now_ns}"
            if moved is not None:
                known = steps[-1].name.encode() + moved.rotation.tobytes() + moved.translation.tobytes()
                name += f"_{hashlib.sha256(known).hexdigest()[:32]}"
            steps.append(_Step(now_ns, moved, name))
        return steps

    def _at(
        self, pair: RectifiedPair | RefusedFrame, steps: list[_Step], chain: int
    ) -> MatchedFrame | Refusal:
        """Match the last pair of `steps`, and those before it as far as it rests on them."""
        before = self._known(steps[-1], chain)
        if before is not None:
            return before
        if steps[-1].now_from_before is not None:
            before = self._known(steps[-2], chain)
            if before is None:
                before = self._at(next(self._pairs({steps[-2].stamp_ns})), steps[:-1], chain)
        found = self._matched(pair, steps[-1], before)
        self._last[chain] = steps[-1].name, found
        return found

    def _known(self, step: _Step, chain: int) -> MatchedFrame | Refusal | None:
        name, found = self._last.get(chain, ("", None))
        return found if name == step.name else None

    def _matched(
        self, pair: RectifiedPair | RefusedFrame, step: _Step, before: MatchedFrame | Refusal | None
    ) -> MatchedFrame | Refusal:
        if isinstance(pair, RefusedFrame):
            return Refusal("recording", pair)

        def match() -> MatchedFrame:
            if isinstance(before, MatchedFrame) and step.now_from_before is not None:
                return self._matcher(pair, Preceding(before, step.now_from_before))
            return self._matcher(pair)

        return checkpointed(self._checkpoints, step.name, match)

    def _motion(self, before_ns: int, now_ns: int, crane: CraneSamples | None) -> Pose | None:
        """Predict now_from_before of the rectified left camera by the encoders, at the nominal attitude; None
        where they don't say.
        """
        if crane is None or crane.stamp_ns.size == 0:
            return None
        at = np.array([before_ns, now_ns], dtype=np.int64) + self._pairs.recording.rig.timeshift_cam_imu_ns
        places = interpolate_at(at, crane.stamp_ns, crane.position_m)
        after = np.minimum(np.searchsorted(crane.stamp_ns, at), crane.stamp_ns.size - 1)
        age = np.maximum(crane.stamp_ns[after] - at, at - crane.stamp_ns[np.maximum(after - 1, 0)])
        if not np.isfinite(places).all() or age.max() > _MAX_READING_AGE_NS:
            return None
        shift = crane.yard_from_body_nominal.T @ (places[0] - places[1])
        mount = self._pairs.rectifier.body_from_rect0
        moved = mount.inverse() @ Pose(mount.target, mount.target, np.eye(3), shift) @ mount
        return Pose("now", "before", moved.rotation, moved.translation)


class MatchedAhead:
    """Matches pairs before their turn by `chain`, two chains side by side; in its turn a pair that would be
    matched otherwise by what has been read since is matched anew.
    """

    def __init__(self, chain: PairChain, pairs: RectifiedPairs) -> None:
        self._chain, self._pairs = chain, pairs
        self._workers = [ThreadPoolExecutor(1) for _ in range(WORKERS)]
        self._begun: dict[int, Future[MatchedFrame | Refusal]] = {}

    def begin(self, stamps_ns: Iterable[int]) -> None:
        """Begin to match pairs that aren't yet."""
        for stamp in stamps_ns:
            if stamp not in self._begun:
                worker = self._workers[self._chain.chain(stamp) % WORKERS]
                self._begun[stamp] = worker.submit(self._match, stamp)

    def __call__(self, pair: RectifiedPair) -> MatchedFrame | Refusal:
        """Return a pair's match, from its beginning where it hasn't begun."""
        begun = self._begun.pop(pair.stamp_ns, None)
        found = None if begun is None else begun.result()
        return self._chain(pair) if found is None or not self.holds(pair.stamp_ns) else found

    def holds(self, stamp_ns: int) -> bool:
        """Tell whether a pair was matched as it would be with the readings that there are now."""
        return self._chain.holds(stamp_ns)

    def close(self) -> None:
        """Drop what hasn't begun, and wait for what has."""
        for worker in self._workers:
            worker.shutdown(cancel_futures=True)

    def _match(self, stamp_ns: int) -> MatchedFrame | Refusal:
        (pair,) = self._pairs(frozenset((stamp_ns,)))
        return self._chain(pair)
