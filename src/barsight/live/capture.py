"""Run the capture process: pictures and readings in, pairs into the ring; it never waits for a reader."""

from __future__ import annotations

import time
from collections.abc import Callable

from barsight.calibration.geometry.rig import StereoRig
from barsight.core.stamps import seconds_to_ns
from barsight.live.link import Link
from barsight.live.settings import CraneConfig
from barsight.live.shared.counters import Counters
from barsight.live.shared.ring import PairRing
from barsight.live.source import ReplayClock, ReplaySource
from barsight.sensors.crane import CraneSource
from barsight.sensors.drivers import both_cameras
from barsight.sensors.pairing import PairFormer
from barsight.sensors.receiver import ReadingReceiver
from barsight.sensors.source import LivePicture, LostPicture, Readings, SensorSigns, Source

POLL_S = 0.002


def capture(link: Link) -> None:
    """Capture until the source ends or the supervisor stops it."""
    board = link.open_counters()

    def may_go_on() -> bool:
        board.beat("capture")
        return not board["supervisor", "stop"]

    if link.source.crane is None:
        recording = link.open_replayed()
        stamps = recording.camera_stamps
        first_ns = int(min(stamps.left_ns[0], stamps.right_ns[0]))
        board["capture", "first_ns"] = first_ns
    board.beat("capture")
    board["capture", "ready"] = 1
    while not (began_ns := board["supervisor", "began_ns"]):
        if not may_go_on():
            return
        time.sleep(POLL_S)
    if link.source.crane is None:
        source: Source = ReplaySource(
            recording, ReplayClock(began_ns, first_ns, link.source.speed), may_go_on
        )
    else:
        # Not earlier: data arriving while nobody reads would be lost.
        source = open_crane(link.source.crane, link.open_recording().rig, link.source.epoch_ns, may_go_on)
    board["capture", "interval_ns"] = source.interval_ns
    Capture(link, board, link.open_ring()).run(source)
    board["capture", "ended"] = 1


def open_crane(
    crane: CraneConfig, rig: StereoRig, epoch_ns: int, may_go_on: Callable[[], bool]
) -> CraneSource:
    """Open the sensors of crane.toml. Raises ConfigError if a port or a library is missing."""
    cameras = both_cameras(crane.cameras, (rig.cam0.width, rig.cam0.height))
    receivers = {name: ReadingReceiver(name, one) for name, one in crane.sensors().items()}
    return CraneSource(cameras, receivers, crane.cameras.rate_hz, epoch_ns, may_go_on)


class Capture:
    """Accepts the packets of a source, and counts them."""

    def __init__(self, link: Link, board: Counters, ring: PairRing) -> None:
        self._board, self._ring, self._speed = board, ring, link.source.speed
        self._readings = {sensor: link.readings(sensor) for sensor in ("imu", "crane")}
        tolerance_ns = seconds_to_ns(link.settings.recording.pair_tolerance_s)
        if half_ns := board["capture", "interval_ns"] // 2:  # beyond it, a neighbouring pair's
            tolerance_ns = min(tolerance_ns, half_ns)
        self._pairs = PairFormer(tolerance_ns)
        self._lost = [board["capture", f"unpaired_cam{camera}"] for camera in (0, 1)]
        self._contradicted = board["capture", "trigger"]
        self._tell = link.tell

    def run(self, source: Source) -> None:
        """Process packets until there are no more."""
        after = {f"cam{camera}": self._board["capture", f"last_cam{camera}_ns"] for camera in (0, 1)}
        for sensor, log in self._readings.items():
            stamps, _ = log.last(1)
            after[sensor] = int(stamps[-1]) if len(stamps) else 0
        for packet in source.packets(after):
            if isinstance(packet, Readings):
                self._readings[packet.sensor].append(packet.stamp_ns, packet.values)
            elif isinstance(packet, LostPicture):
                self._board.add("capture", packet.cause, packet.count)
            elif isinstance(packet, SensorSigns):
                for name, value in packet.values.items():
                    self._board["sensors", name] = value
                for name, why in packet.troubles.items():
                    self._tell(name, why)
            else:
                self._take(packet)
        self._pairs.end()
        self._count_lost()

    def _take(self, picture: LivePicture) -> None:
        """Note the camera's last picture, and write the pair if the picture completes one."""
        board, camera = self._board, f"cam{picture.camera}"
        board["capture", f"last_{camera}_ns"] = picture.stamp_ns
        board.add("capture", f"pictures_{camera}")
        for frame, exposed_ns in self._pairs.push(picture):
            board["capture", "last_pair_ns"] = frame.stamp_ns
            if self._speed == 0:
                self._wait_for_reader()
            self._ring.write(frame, exposed_ns if self._speed else time.monotonic_ns())
            board.add("capture", "paired")
        self._count_lost()

    def _wait_for_reader(self) -> None:
        """Wait until the last pair has been read: at full speed, none may be lost."""
        board, newest = self._board, self._ring.newest
        while board["track", "taken"] < newest and not board["supervisor", "stop"]:
            board.beat("capture")
            time.sleep(POLL_S)

    def _count_lost(self) -> None:
        for camera, before in enumerate(self._lost):
            self._board["capture", f"unpaired_cam{camera}"] = before + self._pairs.lost[camera]
        self._board["capture", "trigger"] = self._contradicted + self._pairs.contradicted
        self._board["capture", "skew_ns"] = self._pairs.skew_ns
        self._board["capture", "max_skew_ns"] = self._pairs.max_skew_ns
