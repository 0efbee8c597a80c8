"""Take pictures from a GigE Vision camera, through viva-genicam."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from barsight.core.arrays import UInt8
from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.sensors.settings import CamerasSettings

with extra("cameras"):
    import viva_genicam as vg

SEARCH_MS = 1000
WAIT_MS = 200
SILENT_S = 2.0
"""A camera that gives nothing for so long and can't be controlled any more is connected anew."""
AGAIN_S = 1.0
STOPPED_S = 0.1
"""A camera needs so long to end its stream."""
WRAP = 65535
"""Cameras of GigE Vision 1 count blocks from 1 to this, then from 1 again."""
SERIALS = ("DeviceSerialNumber", "DeviceID")
CAUSES = {"frames_incomplete": "incomplete", "frames_missed": "missed", "frames_backpressure": "backpressure"}


@dataclass(frozen=True, eq=False)
class RawPicture:
    """A picture as it came. device_ns: the camera's stamp of its exposure. arrival_ns: monotonic.

    trigger: blocks that the camera has counted since it was connected.
    """

    device_ns: int
    arrival_ns: int
    trigger: int
    image: UInt8


@dataclass(frozen=True)
class RawLoss:
    """Pictures that the camera counted and that did not come whole."""

    cause: str
    count: int


def find_cameras(settings: CamerasSettings) -> dict[str, Any]:
    """Find all cameras on the network by serial number, without taking control of one."""
    found: dict[str, Any] = {}
    for device in vg.discover(timeout_ms=SEARCH_MS, iface=settings.interface):
        try:
            with vg.connect_gige(device, iface=settings.interface, monitor=True) as camera:
                found[_serial(camera)] = device
        except vg.GenicamError:
            continue
    return found


def prove_cameras(settings: CamerasSettings, sizes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    """Prove that cam0 and cam1 are there and can be set. sizes: width and height that the calibration has.

    Raises InputError for one that isn't there, is in use, or does not fit its calibration.
    """
    found = find_cameras(settings)
    for number, serial in enumerate(settings.serials):
        if serial not in found:
            there = ", ".join(sorted(found)) or "none"
            raise InputError(
                f"cam{number}", f"no camera of serial number {serial} answers (there: {there})",
                "check its power and cable, and cameras.serials in crane.toml",
            )  # fmt: skip
    for number, serial in enumerate(settings.serials):
        camera = GigeCamera(number, settings, sizes[number])
        camera.open(found[serial])
        camera.close()


class GigeCamera:
    """A camera of one serial number, connected when pictures are asked for and anew after it was lost.

    size: width and height that the calibration has. connects: how often it was connected.
    """

    def __init__(self, number: int, settings: CamerasSettings, size: tuple[int, int]) -> None:
        self._name, self._settings, self._size = f"cam{number}", settings, size
        self._serial = settings.serials[number]
        self._camera: Any = None
        self.connects = 0

    def open(self, device: Any) -> None:
        """Take control and set the camera. Raises InputError where it can't be or does not fit."""
        try:
            self._camera = vg.connect_gige(device, iface=self._settings.interface)
            # A camera whose host was killed sends on to where that was.
            with contextlib.suppress(vg.GenicamError):
                self._camera.acquisition_stop()
                time.sleep(STOPPED_S)
            self._set_up(self._camera)
        except vg.GenicamError as error:
            self.close()
            raise InputError(
                self._name, f"the camera {self._serial} refuses: {_line(error)}",
                "see that no other program controls it and that it has the setting",
            ) from error  # fmt: skip

    def close(self) -> None:
        """Give the camera back."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def pictures(self, may_go_on: Callable[[], bool]) -> Iterator[RawPicture | RawLoss]:
        """Yield pictures and losses as long as `may_go_on` says so; a camera that is lost is sought again."""
        while may_go_on():
            try:
                if self._camera is None:
                    self._connect()
                yield from self._stream(may_go_on)
            except (vg.GenicamError, InputError):
                pass
            if may_go_on():
                self._drop()
                time.sleep(AGAIN_S)
        self.close()

    def _stream(self, may_go_on: Callable[[], bool]) -> Iterator[RawPicture | RawLoss]:
        """Yield from one stream until the camera has been silent for `SILENT_S`."""
        trigger, last_id, told = 0, None, dict.fromkeys(CAUSES, 0)
        with self._camera.stream(packet_size=self._settings.packet_size_bytes) as stream:
            heard = time.monotonic()
            while may_go_on():
                try:
                    frame = stream.next_frame(WAIT_MS)
                except vg.GenicamError:
                    frame = None
                if frame is None:
                    if (
                        time.monotonic() - heard > SILENT_S
                        and self._camera.control_state != vg.ControlState.HELD
                    ):
                        return  # else nothing triggers it
                    continue
                arrival_ns, heard = time.monotonic_ns(), time.monotonic()
                gap = 0 if last_id is None else _step(last_id, frame.block_id) - 1
                last_id, trigger = frame.block_id, trigger + gap + 1
                if gap > 0:
                    yield from _losses(gap, stream.stats(), told)
                yield RawPicture(int(frame.ts_dev or 0), arrival_ns, trigger, frame.to_numpy())

    def _set_up(self, camera: Any) -> None:
        width, height = camera.get_integer("Width"), camera.get_integer("Height")
        if (width, height) != self._size:
            raise InputError(
                self._name,
                f"the camera {self._serial} gives {width}x{height}, the calibration is for "
                f"{self._size[0]}x{self._size[1]}",
                "name the calibration of this rig, or set the camera as it was calibrated",
            )
        if (pixels := camera.get("PixelFormat")) != "Mono8":
            raise InputError(self._name, f"the camera {self._serial} gives {pixels}", "set it to Mono8")
        if self._settings.exposure_us is not None:
            camera.set_exposure_time(self._settings.exposure_us)
        if self._settings.trigger == "free":
            camera.set_frame_rate(self._settings.rate_hz)
        else:
            camera.enable_trigger("FrameStart", self._settings.trigger)

    def _connect(self) -> None:
        found = find_cameras(self._settings)
        if self._serial not in found:
            raise InputError(self._name, "does not answer")
        self.open(found[self._serial])
        self.connects += 1

    def _drop(self) -> None:
        try:
            self.close()
        except vg.GenicamError:
            self._camera = None


def _serial(camera: Any) -> str:
    for name in SERIALS:
        try:
            return str(camera.get(name))
        except vg.GenicamError:
            continue
    return ""


def _step(last: int, block: int) -> int:
    """Count blocks from one number to the next."""
    if last <= WRAP and block <= WRAP:
        return (block - last) % WRAP or 1
    return max(block - last, 1)


def _losses(gap: int, stats: Any, told: dict[str, int]) -> Iterator[RawLoss]:
    """Tell the causes of a gap from the stream's counters; what they don't explain is `missed`."""
    for name, cause in CAUSES.items():
        count = min(getattr(stats, name) - told[name], gap)
        told[name] = getattr(stats, name)
        if count > 0:
            gap -= count
            yield RawLoss(cause, count)
    if gap > 0:
        yield RawLoss("missed", gap)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
