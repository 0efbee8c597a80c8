"""Bring cameras, IMU and encoders onto one clock and into time order: the `Source` of a real crane."""

from __future__ import annotations

import heapq
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from barsight.core.stamps import NS_PER_S
from barsight.sensors.camera import PTP_ROLES, CameraDriver, RawLoss, RawPicture, are_one_clock
from barsight.sensors.clock import MAX_DRIFT, DeviceClock
from barsight.sensors.receiver import RawReading, ReadingReceiver
from barsight.sensors.source import LivePicture, LostPicture, Packet, Readings, SensorSigns

WAIT_S = 0.01
SIGNS_EVERY_S = 1.0
HOLD_INTERVALS = 3
"""Time in picture intervals that a picture waits for an older one of the other camera."""
RAW_PICTURES, RAW_READINGS = 256, 1 << 16
"""Queue sizes for pictures and readings: as many readings as the fastest IMU provides in ten seconds."""
BEHIND_COUNT = 2
"""Successive pictures of a camera whose clock went on by too little after which it was set back: of one alone
the stamp is wrong.
"""
ONE_CLOCK_NS = 5_000_000
"""Largest difference in ns between the smallest delays of two cameras on one network."""

Item = tuple[str, RawPicture | RawLoss | RawReading]


@dataclass
class _Stream:
    """A sensor's clock, the last stamp delivered, a camera's last picture, and losses.

    trigger, device_ns: number and stamp of the last picture whose stamp was believed. exposure_ns: what its
    clock went on for each exposure up to it, 0 until two are known. behind: pictures since, whose stamps were
    not. dropped: readings that found the queue full.
    """

    clock: DeviceClock = field(default_factory=DeviceClock)
    last_ns: int = 0
    trigger: int = 0
    device_ns: int = 0
    exposure_ns: float = 0.0
    behind: int = 0
    lost: int = 0
    dropped: int = 0

    def begin_anew(self) -> None:
        """Forget clock and picture rate so far."""
        self.clock.begin_anew()
        self.exposure_ns = 0.0


class CraneSource:
    """`Source` of two cameras, an IMU and encoders.

    Every stamp is the device's own, mapped to the host's monotonic clock by its `DeviceClock`. Adding
    `epoch_ns` gives the run's stamps, which a step of the host's wall clock can't shift. Cameras with clocks
    synchronised by PTP are mapped with one clock, cam0's, so that their delays can't separate them.
    """

    def __init__(
        self, cameras: tuple[CameraDriver, CameraDriver], receivers: dict[str, ReadingReceiver],
        rate_hz: float, epoch_ns: int, may_go_on: Callable[[], bool],
    ) -> None:  # fmt: skip
        self._cameras, self._receivers, self._epoch_ns = cameras, receivers, epoch_ns
        self._ask, self._going = may_go_on, True
        self.interval_ns = round(NS_PER_S / rate_hz)
        self._streams = {name: _Stream() for name in ("cam0", "cam1", *receivers)}
        self._items: queue.Queue[Item] = queue.Queue()
        self._room = threading.Semaphore(RAW_PICTURES)
        self._held: list[tuple[int, int, int, LivePicture]] = []
        self._overflow = self._device_ns = 0
        self._failed: Exception | None = None

    def packets(self, after: dict[str, int]) -> Iterator[Packet]:
        """Yield packets as they arrive, pictures in time order; see `Source.packets`."""
        for name, stream in self._streams.items():
            stream.last_ns = after[name]
        threads = [
            threading.Thread(
                target=self._take, args=(f"cam{k}", partial(camera.pictures, self._is_going)), daemon=True
            )
            for k, camera in enumerate(self._cameras)
        ]
        threads += [
            threading.Thread(
                target=self._take,
                args=(name, partial(one.readings, self._is_going, time.monotonic_ns)),
                daemon=True,
            )
            for name, one in self._receivers.items()
        ]
        for thread in threads:
            thread.start()
        signs_at = time.monotonic()
        try:
            while self._ask():
                yield from self._next()
                if self._failed is not None:
                    raise self._failed
                if time.monotonic() >= signs_at:
                    signs_at = time.monotonic() + SIGNS_EVERY_S
                    yield SensorSigns(self._signs(), self._troubles())
            yield from self._ordered(until_ns=None)
        finally:
            self._going = False
            for thread in threads:
                thread.join(2.0)
            for receiver in self._receivers.values():
                receiver.close()

    def _take(self, name: str, items: Callable[[], Iterator[RawPicture | RawLoss | RawReading]]) -> None:
        """Take what a sensor gives; an error that its driver doesn't expect ends the source."""
        try:
            for item in items():
                self._put(name, item)
        except Exception as error:
            self._failed = error

    def _is_going(self) -> bool:
        return self._going

    def _put(self, name: str, item: RawPicture | RawLoss | RawReading) -> None:
        if isinstance(item, RawPicture) and not self._room.acquire(blocking=False):
            self._overflow += 1
        elif isinstance(item, RawReading) and self._items.qsize() >= RAW_READINGS:
            self._streams[name].dropped += 1
        else:
            self._items.put((name, item))

    def _next(self) -> Iterator[Packet]:
        """Yield the result of one wait; readings that arrived together form one packet."""
        readings: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
        try:
            name, item = self._items.get(timeout=WAIT_S)
            while True:
                if isinstance(item, RawReading):
                    self._read(name, item, readings)
                else:
                    if isinstance(item, RawPicture):
                        self._room.release()
                    yield from self._picture(name, item)
                name, item = self._items.get_nowait()
        except queue.Empty:
            pass
        for name, rows in readings.items():
            stamps = np.array([stamp for stamp, _ in rows], np.int64)
            yield Readings(name, stamps, np.array([values for _, values in rows], np.float64))
        if self._overflow:
            yield LostPicture(0, 0, "backpressure", self._overflow)
            self._overflow = 0
        yield from self._ordered(time.monotonic_ns() - HOLD_INTERVALS * self.interval_ns)

    def _read(
        self, name: str, item: RawReading, readings: dict[str, list[tuple[int, tuple[float, ...]]]]
    ) -> None:
        stream = self._streams[name]
        stream.lost += item.lost
        if not stream.clock.add(item.device_ns, item.arrival_ns):
            return
        stamp_ns = stream.clock.host_ns(item.device_ns) + self._epoch_ns
        if stamp_ns <= stream.last_ns:
            stream.lost += 1
            return
        stream.last_ns = stamp_ns
        readings.setdefault(name, []).append((stamp_ns, item.values))

    def _picture(self, name: str, item: RawPicture | RawLoss) -> Iterator[Packet]:
        """Stamp a picture and hold it until its turn."""
        camera, stream = int(name[-1]), self._streams[name]
        if isinstance(item, RawLoss):
            yield LostPicture(camera, 0, item.cause, item.count)
            return
        if item.trigger <= stream.trigger:  # connected anew: it may have been set meanwhile
            stream.begin_anew()
        elif stream.trigger and self._is_behind(stream, item):
            if stream.behind < BEHIND_COUNT:
                yield LostPicture(camera, 0, "late")
                return
            stream.clock.jumps += 1
            stream.begin_anew()
        stream.trigger, stream.device_ns, stream.behind = item.trigger, item.device_ns, 0
        if not stream.clock.add(item.device_ns, item.arrival_ns):
            yield LostPicture(camera, 0, "clock")
            return
        self._device_ns, first = item.device_ns, self._streams["cam0"].clock
        exposed_ns = (first if self._are_one(item.device_ns) else stream.clock).host_ns(item.device_ns)
        stamp_ns = exposed_ns + self._epoch_ns
        if stamp_ns <= stream.last_ns:
            yield LostPicture(camera, stamp_ns, "late")
            return
        stream.last_ns = stamp_ns
        picture = LivePicture(camera, stamp_ns, exposed_ns, item.image, item.trigger)
        heapq.heappush(self._held, (stamp_ns, camera, item.arrival_ns, picture))

    def _is_behind(self, stream: _Stream, item: RawPicture) -> bool:
        """Check whether a camera's clock went on by half an interval less than its exposures took.

        Such a stamp is that of an earlier exposure of the other camera: neighbours would be paired.
        """
        exposures, went_on_ns = item.trigger - stream.trigger, item.device_ns - stream.device_ns
        if went_on_ns < (exposures - 0.5) * min(stream.exposure_ns, self.interval_ns):
            stream.behind += 1
            return True
        stream.exposure_ns = went_on_ns / exposures
        return False

    def _are_one(self, device_ns: int) -> bool:
        """Check whether the cameras share one clock: they report so, and a stamp has the same age on both."""
        clocks = [self._streams[f"cam{k}"].clock for k in (0, 1)]
        if not are_one_clock(camera.ptp for camera in self._cameras):
            return False
        if not all(clock.is_settled for clock in clocks):
            return False
        return abs(clocks[0].host_ns(device_ns) - clocks[1].host_ns(device_ns)) < ONE_CLOCK_NS

    def _ordered(self, until_ns: int | None) -> Iterator[Packet]:
        """Yield held pictures that no older one can follow: both cameras are past them, or they arrived
        before `until_ns` (monotonic); None: all.
        """
        past_ns = min(self._streams[f"cam{k}"].last_ns for k in (0, 1))
        while self._held:
            stamp_ns, _, arrival_ns, picture = self._held[0]
            if until_ns is not None and stamp_ns > past_ns and arrival_ns > until_ns:
                return
            heapq.heappop(self._held)
            yield picture

    def _troubles(self) -> dict[str, str]:
        troubles = {camera.name: camera.trouble for camera in self._cameras}
        wild = f"its clock drifts by over {1e6 * MAX_DRIFT:.0f} ppm, its stamps are wrong"
        for name, stream in self._streams.items():
            troubles[f"{name}_clock"] = wild if stream.clock.is_wild else ""
        return troubles

    def _signs(self) -> dict[str, int]:
        signs: dict[str, int] = {}
        for name, stream in self._streams.items():
            clock = stream.clock
            signs |= {
                f"{name}_settled": int(clock.is_settled), f"{name}_drift_ppb": clock.drift_ppb,
                f"{name}_jitter_ns": clock.jitter_ns, f"{name}_jumps": clock.jumps,
                f"{name}_lost": stream.lost + stream.dropped,
            }  # fmt: skip
        for name, receiver in self._receivers.items():
            signs |= {
                f"{name}_torn": receiver.torn, f"{name}_overtaken": receiver.sequence.overtaken,
                f"{name}_restarts": receiver.sequence.restarts,
            }  # fmt: skip
        for number, camera in enumerate(self._cameras):
            signs[f"cam{number}_connects"] = camera.connects
            signs[f"cam{number}_ptp"] = PTP_ROLES.get(camera.ptp, 0)
        signs["one_clock"] = int(self._are_one(self._device_ns))
        return signs
