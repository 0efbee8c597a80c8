"""Acquire pictures from a GigE Vision camera, through viva-genicam."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.core.stamps import NS_PER_S
from barsight.sensors.camera import WAIT_MS, Blocks, CameraDriver, RawLoss, RawPicture
from barsight.sensors.settings import CamerasSettings

with extra("cameras"):
    import viva_genicam as vg

SEARCH_MS = 1000
SILENT_S = 2.0
"""Time in seconds without data after which a camera that can't be controlled either is reconnected."""
STOPPED_S = 0.1
"""Time in seconds that a camera needs to end its stream."""
TICKS, TICKS_REGISTER = "GevTimestampTickFrequency", 0x093C
"""Feature and bootstrap register (8 bytes) with the ticks per second of a camera's clock."""
SERIALS = ("DeviceSerialNumber", "DeviceID")
PTP_STATES = {"PtpStatus": "PtpDataSetLatch", "GevIEEE1588Status": "GevIEEE1588DataSetLatch"}
"""Features with the PTP state, by the newer and the older name, and the command that latches each."""
PTP_EVERY_S = 2.0
CAUSES = {"frames_incomplete": "incomplete", "frames_missed": "missed", "frames_backpressure": "backpressure"}


class GigeCamera(CameraDriver):
    """A GigE Vision camera of any make."""

    errors = vg.GenicamError

    @staticmethod
    def find(settings: CamerasSettings) -> dict[str, Any]:
        """Find all cameras on the network by serial number, without taking control of any."""
        found: dict[str, Any] = {}
        try:
            devices = vg.discover(timeout_ms=SEARCH_MS, iface=settings.interface)
        except vg.GenicamError as error:
            raise InputError(
                "cameras", f"can't be searched: {' '.join(str(error).split())[:200]}",
                "name one of these in cameras.interface, or leave it out to search all",
            ) from error  # fmt: skip
        for device in devices:
            try:
                with vg.connect_gige(device, iface=settings.interface, monitor=True) as camera:
                    found[_serial(camera)] = device
            except vg.GenicamError:
                continue
        return found

    def _control(self, device: Any) -> None:
        camera = self._camera = vg.connect_gige(device, iface=self._settings.interface)
        # A camera whose host was killed continues to send to it.
        with contextlib.suppress(vg.GenicamError):
            camera.acquisition_stop()
            time.sleep(STOPPED_S)
        self._expect(camera.get_integer("Width"), camera.get_integer("Height"), camera.get("PixelFormat"))
        self._tick_hz = self._find_ticks()
        if self._settings.exposure_us is not None:
            camera.set_exposure_time(self._settings.exposure_us)
        if self._settings.trigger == "free":
            camera.set_frame_rate(self._settings.rate_hz)
        else:
            camera.enable_trigger("FrameStart", self._settings.trigger)
        self.ptp = self._read_ptp()

    def _find_ticks(self) -> int:
        """Return the ticks per second of the camera's clock. Raises InputError if it has no clock."""
        try:
            ticks: int = self._camera.get_integer(TICKS)
        except vg.GenicamError:
            ticks = int.from_bytes(self._camera.read_register(TICKS_REGISTER, 8), "big")
        if ticks <= 0:
            raise self._no_clock()
        return ticks

    def _read_ptp(self) -> str:
        for state, latch in PTP_STATES.items():
            try:
                with contextlib.suppress(vg.GenicamError):  # not every camera has it
                    self._camera.execute(latch, wait=False)
                self._camera.invalidate(state)
                return str(self._camera.get(state))
            except vg.GenicamError:
                continue
        return ""

    def _release(self) -> None:
        self._camera.close()

    def _stream(self, may_go_on: Callable[[], bool]) -> Iterator[RawPicture | RawLoss]:
        """Yield from one stream until the camera has been silent for `SILENT_S`."""
        blocks = Blocks()
        with self._camera.stream(packet_size=self._settings.packet_size_bytes) as stream:
            heard = asked = time.monotonic()
            while may_go_on():
                if self.ptp and time.monotonic() - asked > PTP_EVERY_S:
                    self.ptp, asked = self._read_ptp() or "lost", time.monotonic()
                try:
                    frame = stream.next_frame(WAIT_MS)
                except vg.GenicamError:
                    frame = None
                if frame is None:
                    if (
                        time.monotonic() - heard > SILENT_S
                        and self._camera.control_state != vg.ControlState.HELD
                    ):
                        return  # otherwise it isn't being triggered
                    continue
                arrival_ns, heard = time.monotonic_ns(), time.monotonic()
                if (gap := blocks.gap(frame.block_id)) > 0:
                    stats = stream.stats()
                    counters = {cause: getattr(stats, name) for name, cause in CAUSES.items()}
                    yield from blocks.losses(gap, counters)
                device_ns = (frame.ts_dev or 0) * NS_PER_S // self._tick_hz
                yield RawPicture(device_ns, arrival_ns, blocks.trigger, frame.to_numpy())


def _serial(camera: Any) -> str:
    for name in SERIALS:
        try:
            return str(camera.get(name))
        except vg.GenicamError:
            continue
    return ""
