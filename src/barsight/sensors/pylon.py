"""Acquire pictures from a Basler camera, through pypylon."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from barsight.core.extras import extra
from barsight.core.stamps import NS_PER_S
from barsight.sensors.camera import WAIT_MS, Blocks, CameraDriver, RawLoss, RawPicture
from barsight.sensors.settings import CamerasSettings

with extra("basler"):
    from pypylon import genicam, pylon

EXPOSURE, RATE = ("ExposureTime", "ExposureTimeAbs"), ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
"""Feature names of newer cameras, and of older GigE cameras."""
TICKS, STAMPS_NS = "GevTimestampTickFrequency", "TimestampLatchValue"
"""Features of older GigE cameras, which report the length of a tick; other cameras with a clock stamp in
ns.
"""
UNDERRUNS = "Statistic_Buffer_Underrun_Count"
HEADERS_BYTES = 28
"""Size of the IPv4 and UDP headers, which the camera counts as part of a packet."""


class PylonCamera(CameraDriver):
    """A Basler camera, connected by GigE or USB."""

    errors = genicam.GenericException

    @staticmethod
    def find(settings: CamerasSettings) -> dict[str, Any]:
        """Find all cameras at this computer by serial number, without taking control of any."""
        return {one.GetSerialNumber(): one for one in pylon.TlFactory.GetInstance().EnumerateDevices()}

    def _control(self, device: Any) -> None:
        camera = self._camera = pylon.InstantCamera(pylon.TlFactory.GetInstance().CreateDevice(device))
        # pylon's default configuration would disable the camera's trigger.
        camera.RegisterConfiguration(
            pylon.ConfigurationEventHandler(), pylon.RegistrationMode_ReplaceAll, pylon.Cleanup_Delete
        )
        camera.Open()
        self._expect(camera.Width.Value, camera.Height.Value, camera.PixelFormat.Value)
        self._tick_hz = self._find_ticks()
        camera.AcquisitionMode.Value = "Continuous"
        if genicam.IsWritable(packet := self._nodes.GetNode("GevSCPSPacketSize")):
            size = self._settings.packet_size_bytes + HEADERS_BYTES
            packet.SetValue(size, pylon.IntegerValueCorrection_Down)
        if self._settings.exposure_us is not None:
            self._node(*EXPOSURE).Value = self._settings.exposure_us
        if self._settings.trigger == "free":
            if genicam.IsWritable(enable := self._nodes.GetNode("AcquisitionFrameRateEnable")):
                enable.Value = True
            self._node(*RATE).Value = self._settings.rate_hz
        else:
            camera.TriggerSelector.Value = "FrameStart"
            camera.TriggerSource.Value = self._settings.trigger
            camera.TriggerMode.Value = "On"

    def _release(self) -> None:
        self._camera.Close()

    def _stream(self, may_go_on: Callable[[], bool]) -> Iterator[RawPicture | RawLoss]:
        """Yield from one stream until the camera is gone."""
        camera, blocks, failed = self._camera, Blocks(), 0
        underruns = camera.GetStreamGrabberNodeMap().GetNode(UNDERRUNS)
        camera.StartGrabbing(pylon.GrabStrategy_OneByOne)
        while may_go_on():
            result = camera.RetrieveResult(WAIT_MS, pylon.TimeoutHandling_Return)
            arrival_ns = time.monotonic_ns()
            if not result.IsValid():
                if camera.IsCameraDeviceRemoved() or not camera.IsGrabbing():
                    return  # otherwise it isn't being triggered
                continue
            if not result.GrabSucceeded():
                failed += 1  # its block counts as missing before the next one
                continue
            if (gap := blocks.gap(result.BlockID)) > 0:
                starved = underruns.Value if genicam.IsReadable(underruns) else 0
                yield from blocks.losses(gap, {"incomplete": failed, "backpressure": starved})
            device_ns = result.TimeStamp * NS_PER_S // self._tick_hz
            picture = RawPicture(device_ns, arrival_ns, blocks.trigger, result.Array)
            result.Release()
            yield picture

    def _find_ticks(self) -> int:
        """Return the ticks per second of the camera's clock. Raises InputError if it has no clock."""
        if genicam.IsReadable(ticks := self._nodes.GetNode(TICKS)):
            return int(ticks.Value)
        if genicam.IsImplemented(self._nodes.GetNode(STAMPS_NS)):
            return NS_PER_S
        raise self._no_clock()

    @property
    def _nodes(self) -> Any:
        return self._camera.GetNodeMap()

    def _node(self, name: str, older: str) -> Any:
        node = self._nodes.GetNode(name)
        return node if genicam.IsImplemented(node) else self._nodes.GetNode(older)
