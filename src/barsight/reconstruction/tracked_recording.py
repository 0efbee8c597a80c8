"""Estimate a recording's trajectory while its first pairs are matched."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice, takewhile
from pathlib import Path

from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.stereo.disparity_uncertainty import rig_covariance
from barsight.core.arrays import Float64
from barsight.core.errors import InputError, MeasurementError
from barsight.core.memory import trim_heap
from barsight.core.parallel import WORKERS, prefetched_chain
from barsight.core.records.pairs import RectifiedPair, RefusedFrame
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.core.timing import ProgressCallback, Stopwatch, count_frames
from barsight.mapping.keyframes import KeyframeSelection, select_keyframes_by_encoders
from barsight.mapping.view import MatchedFrame, Matcher, check_pair
from barsight.measure_settings import MeasureSettings
from barsight.measurement import Refusal
from barsight.motion.rig_check.self_calibration import residual_covariance, self_calibrate
from barsight.motion.settings import make_estimator
from barsight.reconstruction.checkpoint import checkpointed, trajectory_name
from barsight.reconstruction.pair_chain import PairChain
from barsight.reconstruction.probed_recording import ProbedRecording
from barsight.recording.base import Recording
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.stereo.settings import StereoSettings, make_map_method
from barsight.yard_frame import frame_of, placed_in_yard

_MATCHED_AHEAD, _MATCHED_AFTER = 16, 4
"""Maximum number of matched pairs that wait, during and after the trajectory's estimation: 13 MB each at
1280x1024.
"""


@dataclass(frozen=True, eq=False)
class TrackedRecording:
    """The trajectory, and the pairs from which the map is made. rectifier: corrected by self-calibration
    if set. stereo: with the disparity's calibration sigma. rig_covariance: of yaw, baseline and focal
    length (3, 3), None where no rig file gives it. poses: of the selected frames, by stamp. refusals: of
    frames that would have been selected. matched: the selected frames, in order.
    """

    trajectory: Trajectory
    rectifier: Rectifier
    stereo: StereoSettings
    rig_covariance: Float64 | None
    drift_warnings: tuple[str, ...]
    poses: dict[int, PosedFrame]
    refusals: tuple[Refusal, ...]
    matched: Iterator[MatchedFrame | Refusal]

    @property
    def passed_over(self) -> int:
        """Return the number of located frames whose picture had moved too little to be mapped."""
        return len(self.trajectory.frames) - len(self.poses) - len(self.refusals)


@contextmanager
def estimate_trajectory(
    probed: ProbedRecording, settings: MeasureSettings, advance: ProgressCallback
) -> Iterator[TrackedRecording]:
    """Estimate the trajectory while the first pairs are matched on the idle core."""
    source, pairs, watch = probed.source, probed.pairs, probed.watch
    rectifier, total = pairs.rectifier, len(source.index.stamps_ns)
    match = matching(pairs, settings, probed.checkpoints, watch)
    early = _known_early(source, settings, rectifier, probed.first.range_m)
    wanted = set(early)
    begun = (pair for pair in islice(pairs(early), len(early)) if pair.stamp_ns in wanted)
    with ExitStack() as pools:
        ahead = pools.enter_context(_matched_ahead(match, begun, _MATCHED_AHEAD))
        with watch("trajectory", total):
            estimate = make_estimator(settings.motion)
            count = count_frames("trajectory", total, advance)
            with _naming(probed):
                name = trajectory_name(source, estimate.delay_ns)
                trajectory = checkpointed(
                    probed.checkpoints, name, lambda: estimate(source, rectifier, count, pairs)
                )
            trajectory = placed_in_yard(trajectory, frame_of(source))
            trim_heap()
            calibrated = self_calibrate(
                source.rig, rectifier, trajectory.drift, probed.calibration_px,
                correct=settings.self_calibrate == "yaw",
            )  # fmt: skip
        if calibrated.rectifier is not rectifier:
            rectifier = calibrated.rectifier
            pairs = RectifiedPairs(source, rectifier, watch=watch)
            match = matching(pairs, settings, probed.checkpoints, watch)
        stereo = replace(settings.stereo, calibration_sigma_px=calibrated.sigma_px)
        selection = KeyframeSelection(rectifier, probed.first.range_m, settings.map.min_shift)
        poses, refusals = select_keyframes(trajectory.frames, pairs.reader(), selection, settings.stereo)
        wanted &= match.with_predecessors(poses)
        late = min((stamp for stamp in poses if stamp not in early), default=None)
        matched: Iterator[MatchedFrame | Refusal] = ahead
        if late is not None:
            rest = pairs({stamp for stamp in poses if stamp >= late})
            after = pools.enter_context(_matched_ahead(match, rest, _MATCHED_AFTER))
            matched = chain(takewhile(lambda frame: frame.stamp_ns < late, ahead), after)
        rig = rig_covariance(settings.recording.rig, probed.first.range_m)
        if rig is not None:
            corrected = settings.self_calibrate == "yaw"
            rig = residual_covariance(rig, trajectory.drift, corrected=corrected)
        moved = calibrated.warnings + trajectory.rig_moved
        yield TrackedRecording(trajectory, rectifier, stereo, rig, moved, poses, refusals, matched)


def select_keyframes(
    frames: Sequence[PosedFrame], read: Callable[[int], RectifiedPair | RefusedFrame],
    selection: KeyframeSelection, stereo: StereoSettings,
) -> tuple[dict[int, PosedFrame], tuple[Refusal, ...]]:  # fmt: skip
    """Select the frames to be mapped, by stamp: keyframes and the last frame. A frame that can't be matched
    is refused instead, and the next one is considered. read: reads a frame's pair.
    """
    taken, refusals = dict[int, PosedFrame](), list[Refusal]()
    for frame in frames:
        if not selection.is_due(frame) and frame is not frames[-1]:
            continue
        pair = read(frame.stamp_ns)
        if isinstance(pair, RefusedFrame):
            refusals.append(Refusal("recording", pair))
        elif (nothing := check_pair(pair, stereo)) is not None:
            refusals.append(Refusal("stereo", RefusedFrame(pair.stamp_ns, nothing.reason)))
        else:
            taken[pair.stamp_ns] = frame
            selection.take(frame)
    return taken, tuple(refusals)


@contextmanager
def _naming(probed: ProbedRecording) -> Iterator[None]:
    """Report implausible samples as the cause if nothing can be estimated from them."""
    try:
        yield
    except (InputError, MeasurementError) as error:
        if not probed.doubts:
            raise
        told = "; ".join(doubt.message for doubt in probed.doubts)
        raise InputError(probed.source.path, told, str(error)) from error


def _known_early(
    source: Recording, settings: MeasureSettings, rectifier: Rectifier, range_m: float
) -> frozenset[int]:
    """Select stamps of frames that may be matched before the trajectory is known: all, or the first few
    that are far enough apart by the encoders. Where the trajectory selects otherwise, it takes precedence.
    """
    stamps, min_shift = source.index.stamps_ns, settings.map.min_shift
    if settings.self_calibrate != "none":
        return frozenset()
    if min_shift == 0:
        return frozenset(stamps)
    crane = source.crane()
    if crane is None or crane.stamp_ns.size == 0:
        return frozenset()
    shift_ns = source.rig.timeshift_cam_imu_ns
    chosen = select_keyframes_by_encoders(stamps, crane, shift_ns, rectifier.camera, range_m, min_shift)
    return frozenset(chosen[:_MATCHED_AHEAD])


def matching(
    pairs: RectifiedPairs, settings: MeasureSettings, checkpoints: Path | None, watch: Stopwatch
) -> PairChain:
    """Create the matcher of a recording's pairs for its map."""
    stereo, every = settings.stereo, settings.map.min_shift == 0
    chained = every and stereo.method == "barsight" and stereo.barsight.preset == "best"
    matcher = Matcher(stereo, make_map_method(stereo), watch)
    return PairChain(pairs, matcher, stereo.confirmed_pairs + 1 if chained else 1, checkpoints)


def _matched_ahead(
    match: PairChain, pairs: Iterator[RectifiedPair | RefusedFrame], max_waiting: int
) -> AbstractContextManager[Iterator[MatchedFrame | Refusal]]:
    """Match pairs ahead, whole chains in parallel; about `max_waiting` of them may wait."""
    chains = max(max_waiting // match.length, WORKERS)
    return prefetched_chain(partial(map, match), match.split(pairs), chains)
