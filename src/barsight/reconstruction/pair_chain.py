"""Match pairs in chains: the first of each chain without a prediction, the others from the previous
disparity.
"""

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
"""Maximum age of the encoder readings around a stamp for its position to be known. A live session has them
all by then.
"""


@dataclass(frozen=True, eq=False)
class _Step:
    """A pair of a chain. now_from_before: motion of the rectified left camera since the previous pair,
    from the encoders; None at the start of the chain and where they don't give it. name: identifies
    everything that its match depends on besides the pictures.
    """

    stamp_ns: int
    now_from_before: Pose | None
    name: str


class PairChain:
    """Matches the pairs of `pairs`, each once for all runs that share `checkpoints`.

    Results depend on the recording alone, not on which pairs are requested or in what order: a pair whose
    predecessor wasn't requested matches that one too. A chain starts every `length` pairs, and where the
    encoders don't give the camera's motion. Several threads may call it at once. For a recording that is
    still growing, `holds` tells which results are still valid.
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
        """Check whether a pair was matched as it would be with the readings available now."""
        return self._names.get(stamp_ns) == self._steps(stamp_ns)[-1].name

    def follows(self, stamp_ns: int) -> bool:
        """Check whether a pair is predicted from the previous one: it isn't the first of a chain, and
        encoders give the motion.
        """
        return self._steps(stamp_ns)[-1].now_from_before is not None

    def with_predecessors(self, stamps_ns: Iterable[int]) -> set[int]:
        """Return stamps of pairs, and of those before them in their chains, which are matched for them."""
        stamps, found = self._pairs.recording.index.stamps_ns, set[int]()
        for place in map(self._place, stamps_ns):
            found.update(stamps[place - place % self.length : place + 1])
        return found

    def split(
        self, pairs: Iterable[RectifiedPair | RefusedFrame]
    ) -> Iterator[list[RectifiedPair | RefusedFrame]]:
        """Split pairs in order of time by chain; chains can be matched in parallel."""
        for _, together in groupby(pairs, lambda pair: self.chain(pair.stamp_ns)):
            yield list(together)

    def chain(self, stamp_ns: int) -> int:
        """Return the number of the chain that a pair belongs to; chains can be matched in parallel."""
        return self._place(stamp_ns) // self.length

    def _place(self, stamp_ns: int) -> int:
        return bisect_left(self._pairs.recording.index.stamps_ns, stamp_ns)

    def _steps(self, stamp_ns: int) -> list[_Step]:
        """List the pairs of a chain up to and including the given one."""
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
        """Match the last pair of `steps`, and those before it as far as it depends on them."""
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
        """Predict now_from_before of the rectified left camera from the encoders, at the nominal attitude;
        None where they don't give it.
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
    """Matches pairs ahead of their turn by `chain`, several chains in parallel; a pair that later readings
    would have matched otherwise is matched again in its turn.
    """

    def __init__(self, chain: PairChain, pairs: RectifiedPairs) -> None:
        self._chain, self._pairs = chain, pairs
        self._workers = [ThreadPoolExecutor(1) for _ in range(WORKERS)]
        self._begun: dict[int, Future[MatchedFrame | Refusal]] = {}

    def begin(self, stamps_ns: Iterable[int]) -> None:
        """Start matching the pairs that haven't been started yet."""
        for stamp in stamps_ns:
            if stamp not in self._begun:
                worker = self._workers[self._chain.chain(stamp) % WORKERS]
                self._begun[stamp] = worker.submit(self._match, stamp)

    def __call__(self, pair: RectifiedPair) -> MatchedFrame | Refusal:
        """Return a pair's match, computing it now if it hasn't been started; earlier pairs are dropped."""
        for stamp in [stamp for stamp in self._begun if stamp < pair.stamp_ns]:
            self._begun.pop(stamp).cancel()
        begun = self._begun.pop(pair.stamp_ns, None)
        found = None if begun is None else begun.result()
        return self._chain(pair) if found is None or not self.holds(pair.stamp_ns) else found

    def holds(self, stamp_ns: int) -> bool:
        """Check whether a pair was matched as it would be with the readings available now."""
        return self._chain.holds(stamp_ns)

    def close(self) -> None:
        """Cancel what hasn't started, and wait for the rest."""
        for worker in self._workers:
            worker.shutdown(cancel_futures=True)

    def _match(self, stamp_ns: int) -> MatchedFrame | Refusal:
        (pair,) = self._pairs(frozenset((stamp_ns,)))
        return self._chain(pair)
