"""Run the track process: estimate the pose of the newest pair in the ring, keep keyframes for the map."""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64, UInt8
from barsight.core.compiling.ahead import load_kernels
from barsight.core.errors import BarsightError, Failed, MeasurementError
from barsight.core.files import atomic_path
from barsight.core.records.pairs import RectifiedPair, RefusedFrame, StereoFrame
from barsight.core.records.trajectory import PosedFrame
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.live.link import GrowingRecording, Link
from barsight.live.shared.counters import OFF, Counters
from barsight.live.shared.ring import CapturedPair, PairRing
from barsight.motion.fixed_lag.estimator import FixedLagPoses
from barsight.motion.frontend.tracking import REPEATED_M, repeated_sentence
from barsight.motion.settings import make_estimator
from barsight.reconstruction.live_map import PairPlacer
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.stereo.search_range import check_matchable

POLL_S = 0.002
GRACE_S = 0.3
"""Longest time in seconds that a frame waits for the readings of a sensor that has gone silent."""
UNMATCHABLE_PAIRS = 3
"""Number of pairs in succession that are reported if nothing in them can be matched, as by covered lenses."""
UNTIED_PAIRS = 8
"""Number of pairs in succession that are reported if their pictures don't follow from each other."""
AGAIN_FRAMES = 10
"""Number of last keyframes that a restarted process tracks first: more than the window holds."""


def track(link: Link) -> None:
    """Track until capture has ended and its last pair is processed, or the supervisor stops this."""
    whole, board = link.open_recording(), link.open_counters()
    ring = link.open_ring()
    tracking = Tracking(link, GrowingRecording(whole, [], link), board, ring)
    load_kernels("measure")
    tracking.follow_again()
    board.beat("track")
    board["track", "ready"] = 1
    while not board["supervisor", "stop"]:
        board.beat("track")
        ended = board["capture", "ended"]
        newest, taken = ring.newest, board["track", "taken"]
        if newest <= taken:
            if ended:
                break
            time.sleep(POLL_S)
            continue
        pair = ring.read(newest)
        if pair is None:
            continue
        board["track", "taken"] = newest
        tracking.take(pair, range(taken + 1, newest))
    tracking.end()
    board["track", "done"] = 1


class RepeatWatch:
    """Detects a camera that gives the same picture again and again while the crane travels."""

    def __init__(self) -> None:
        self._images: list[UInt8 | None] = [None, None]
        self._since_m: list[Float64] = [np.zeros((0, 3))] * 2

    def check(self, frame: StereoFrame, place_m: Float64) -> str:
        """Examine the next pair; return which camera repeats its picture, "" if none does.

        place_m: (1, 3) the encoders' newest reading; empty without one.
        """
        found = []
        for camera, image in enumerate((frame.left, frame.right)):
            before, since_m = self._images[camera], self._since_m[camera]
            if before is None or not np.array_equal(image, before) or not len(since_m):
                self._images[camera], self._since_m[camera] = image, place_m
            elif len(place_m) and np.linalg.norm(place_m - since_m) > REPEATED_M:
                found.append(f"cam{camera}")
        return repeated_sentence(found) if found else ""


class Tracking:
    """Estimates each pair's pose from the data available when it arrives, and keeps the keyframes."""

    def __init__(self, link: Link, recording: GrowingRecording, board: Counters, ring: PairRing) -> None:
        self._link, self._recording, self._board, self._ring = link, recording, board, ring
        self._rectifier = Rectifier(recording.rig)
        self._pairs = RectifiedPairs(recording, self._rectifier, link.checkpoints)
        self._frames, self._states = link.frames(), link.states()
        self._source = recording.in_use()
        motion = replace(link.settings.motion, estimator="live")
        self._estimator = make_estimator(motion)
        self._placer: PairPlacer | None = None
        self._last_kept: Float64 | None = None
        self._last_kept_ns, self._still = 0, 0
        self._off_um: list[int] = []
        self._unmatchable = 0
        self._repeats, self._encoders = RepeatWatch(), link.readings("crane")

    def follow_again(self) -> None:
        """Track the last keyframes again after a restart; without encoders, all of them."""
        kept = [stamp for stamp, _, _, is_kept, _ in self._frames.read() if is_kept]
        self._recording.grow()
        again = kept if self._source.crane() is None else kept[-AGAIN_FRAMES:]
        self._recording.stamps_ns[:] = kept
        for seen in self._pairs(frozenset(again)) if again else ():
            self._board.beat("track")  # without encoders all keyframes are tracked, which may take minutes
            posed = self._placed(seen)
            self._last_kept_ns = seen.stamp_ns
            if isinstance(posed, PosedFrame):
                self._last_kept = posed.reference_from_body.translation
        self._off_um = [self._board["track", name] - um for name, um in self._encoders_um().items()]

    def end(self) -> None:
        """Save the trajectory, if it consists of exactly the pairs kept."""
        if self._placer is not None:
            with contextlib.suppress(BarsightError):
                self._placer.finish()

    def take(self, pair: CapturedPair, passed: range) -> None:
        """Track a pair from the ring and keep it if it is a keyframe.

        passed: numbers of the skipped pairs before it; as many of them as the map would otherwise lack are
        kept without a pose.
        """
        stamp = pair.frame.stamp_ns
        rectified = self._rectifier(pair.frame)
        if isinstance(rectified, Failed):
            posed: PosedFrame | RefusedFrame = RefusedFrame(stamp, rectified.reason)
        else:
            self._wait_for_readings(stamp)
            posed = self._placed(rectified)
            self._tell_pictures(check_matchable(rectified), pair.frame)
        has_pose = isinstance(posed, PosedFrame)
        self._board.add("track", "tracked" if has_pose else "not_placed")
        if isinstance(posed, PosedFrame):
            self._tell_state()
            self._tell_encoders()
        done_ns = time.monotonic_ns()
        for number in passed:
            self._keep_passed(self._ring.read(number))
        is_kept = isinstance(rectified, RectifiedPair) and self._is_keyframe(stamp, posed)
        if isinstance(rectified, RectifiedPair) and is_kept:
            self._keep(rectified, pair.frame)
        if isinstance(posed, PosedFrame) and is_kept:
            self._last_kept = posed.reference_from_body.translation
        self._frames.append((stamp, pair.exposed_ns, done_ns, is_kept, has_pose))

    def _tell_state(self) -> None:
        """Log the state for the process that writes poses."""
        poses = None if self._placer is None else self._placer.poses
        state = poses.navigation if isinstance(poses, FixedLagPoses) else None
        if state is not None:
            self._states.append(np.array([state.stamp_ns]), state.row[None])

    def _tell_encoders(self) -> None:
        """Report how far the encoders are off by cameras and IMU, also since before a restart."""
        for before_um, (name, um) in zip(self._off_um, self._encoders_um().items(), strict=True):
            self._board["track", name] = before_um + um

    def _encoders_um(self) -> dict[str, int]:
        poses = None if self._placer is None else self._placer.poses
        off_m = poses.encoders_off_m if isinstance(poses, FixedLagPoses) else np.zeros(3)
        return {name: round(1e6 * off) for name, off in zip(OFF, off_m.tolist(), strict=True)}

    def _tell_pictures(self, nothing: Failed | None, frame: StereoFrame) -> None:
        """Report why nothing can be matched or followed, once that holds for several pairs in succession, and
        which camera repeats its picture.
        """
        self._unmatchable = 0 if nothing is None else self._unmatchable + 1
        poses = None if self._placer is None else self._placer.poses
        why = self._repeats.check(frame, self._encoders.last(1)[1])
        if nothing is not None and self._unmatchable >= UNMATCHABLE_PAIRS:
            why = nothing.reason
        elif isinstance(poses, FixedLagPoses) and poses.untied >= UNTIED_PAIRS:
            why = "the pictures no longer follow from each other: dark, covered or displaced?"
        self._link.tell("pictures", why)

    def _keep_passed(self, pair: CapturedPair | None) -> None:
        """Keep a skipped pair if it is far enough from the last one kept."""
        if pair is not None and self._is_wanted(pair.frame.stamp_ns):
            rectified = self._rectifier(pair.frame)
            if isinstance(rectified, RectifiedPair):
                self._keep(rectified, pair.frame)
                self._board.add("track", "kept_passed")
                self._frames.append((pair.frame.stamp_ns, pair.exposed_ns, time.monotonic_ns(), True, False))
                return
        self._board.add("track", "newer_pair")

    def _is_wanted(self, stamp_ns: int) -> bool:
        if self._link.keyframes is not None:
            return stamp_ns in self._link.keyframes
        return stamp_ns - self._last_kept_ns >= seconds_to_ns(self._link.live.passed_every_s)

    def _keep(self, pair: RectifiedPair, frame: StereoFrame) -> None:
        self._pairs.store(pair)
        self._recording.stamps_ns.append(pair.stamp_ns)
        if self._link.source.crane is not None:
            with atomic_path(self._link.raw_file(pair.stamp_ns)) as path, path.open("wb") as stream:
                np.save(stream, np.stack([frame.left, frame.right]))
        self._last_kept_ns = pair.stamp_ns
        self._board.add("track", "kept")

    def _is_keyframe(self, stamp_ns: int, posed: PosedFrame | RefusedFrame) -> bool:
        """Choose keyframes: pairs for which the body has moved far enough, the first few of a standing crane,
        and those without a pose, unless their pictures are old.
        """
        if self._link.keyframes is not None:
            return stamp_ns in self._link.keyframes
        if isinstance(posed, RefusedFrame):
            return not posed.is_stale
        if self._last_kept is None:
            return True
        way_m = np.linalg.norm(posed.reference_from_body.translation - self._last_kept)
        if way_m >= self._link.live.keyframe_way_m:
            self._still = 0
            return True
        self._still += self._is_wanted(stamp_ns)
        return self._is_wanted(stamp_ns) and self._still <= self._link.live.still_pairs

    def _wait_for_readings(self, stamp_ns: int) -> None:
        """Wait for the readings that the pose needs, at most `GRACE_S`."""
        delay_ns = 0 if self._placer is None else self._placer.poses.delay_ns or 0
        due_ns = stamp_ns + self._recording.rig.timeshift_cam_imu_ns + delay_ns
        give_up_ns = time.monotonic_ns() + int(GRACE_S * NS_PER_S)
        while True:
            self._recording.grow()
            last = self._recording.last_readings_ns()
            if all(last.get(sensor, 0) >= due_ns for sensor in self._expected):
                return
            if time.monotonic_ns() >= give_up_ns or self._board["supervisor", "stop"]:
                return
            time.sleep(POLL_S)

    @property
    def _expected(self) -> set[str]:
        return self._link.sensors(self._recording.whole)

    def _placed(self, seen: RectifiedPair | RefusedFrame) -> PosedFrame | RefusedFrame:
        try:
            if self._placer is None and "crane" in self._expected and self._source.crane() is None:
                return RefusedFrame(seen.stamp_ns, "the encoders have given no reading yet")
            if self._placer is None:
                pairs = RectifiedPairs(self._source, self._rectifier, self._link.checkpoints)
                self._placer = PairPlacer(pairs, self._estimator, self._link.checkpoints, reads=False)
            posed = self._placer.push(seen)
        except MeasurementError as error:
            return RefusedFrame(seen.stamp_ns, str(error))
        assert posed is not None, "the live estimator's poses are final at once"
        return posed
