"""Settings of the sensors in crane.toml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from barsight.core.errors import ConfigError
from barsight.core.pose import Pose
from barsight.core.settings.values import expect_choice, expect_ranges, expect_values
from barsight.sensors.forms import CRC_BYTES, FORMS

PORTS = (1, 65535)
BAUDS = (
    9600, 19200, 38400, 57600, 115200, 230400, 460800, 500000, 576000, 921600, 1000000, 1152000, 1500000,
    2000000, 2500000, 3000000, 3500000, 4000000,
)  # fmt: skip
BITS_PER_BYTE = 10
"""Bits per byte on a serial line, including start and stop bit."""
MAX_LEVER_M = 30.0


@dataclass(frozen=True)
class CamerasSettings:
    """The two cameras, triggered together, Mono8."""

    serials: tuple[str, str]
    """Serial numbers (DeviceSerialNumber, otherwise DeviceID) of cam0 and cam1."""
    rate_hz: float
    """Picture rate in pictures per second."""
    exposure_us: float | None = None
    """Exposure time in microseconds; without it the camera's own setting is kept."""
    trigger: str = "free"
    """Input line that triggers both cameras, for example Line1; `free` keeps the camera's own setting."""
    packet_size_bytes: int = 8000
    """Payload of a packet in bytes; above 1500 the network must carry jumbo frames (MTU 9000)."""
    interface: str | None = None
    """Name or IPv4 address of the host's network interface to the cameras; without it all are searched.

    The driver `pylon` always searches all.
    """
    driver: Literal["gige", "pylon"] = "gige"
    """Camera driver. `gige`: any GigE Vision camera, extra `cameras`. `pylon`: Basler by GigE or USB, extra
    `basler`.
    """

    def __post_init__(self) -> None:
        expect_values(self, "cameras.")
        expect_ranges(
            self, "cameras.", rate_hz=(0.5, 200), exposure_us=(5, 200_000), packet_size_bytes=(500, 16000)
        )
        interval_us = 1e6 / self.rate_hz
        if self.exposure_us is not None and self.exposure_us >= interval_us:
            raise ConfigError(
                f"cameras.exposure_us is {self.exposure_us:g}, over the interval between pictures, "
                f"{interval_us:.0f}; give microseconds, or a lower cameras.rate_hz"
            )
        if self.serials[0] == self.serials[1]:
            raise ConfigError(f"cameras.serials names {self.serials[0]} twice; give cam0's and cam1's")


@dataclass(frozen=True, kw_only=True)
class ReadingsSettings:
    """Input of a sensor's readings: a UDP port or a serial line."""

    port: int | None = None
    """UDP port on which the datagrams arrive; give this or `device`."""
    device: str | None = None
    """Serial line that carries the readings, such as /dev/serial/by-id/usb-...; give this or `port`. Linux
    only.
    """
    baud: int | None = None
    """Speed of the serial line in bits per second, for example 921600."""
    rate_hz: float
    """Rate in readings per second."""

    @property
    def way(self) -> str:
        """Describe the input in words."""
        return f"UDP port {self.port}" if self.device is None else f"{self.device} at {self.baud} baud"

    def _expect_way(self, section: str, sensor: str) -> None:
        """Raise ConfigError if neither or both inputs are given, or if the line is too slow."""
        expect_ranges(self, section, port=PORTS)
        if (self.port is None) == (self.device is None):
            told = "neither is" if self.port is None else "both are"
            raise ConfigError(
                f"{section}port and {section}device: {told} given; give the UDP port or the serial line"
            )
        if (self.device is None) != (self.baud is None):
            raise ConfigError(f"{section}device and {section}baud belong together; give both or none")
        if self.baud is not None:
            expect_choice(f"{section}baud", self.baud, BAUDS)
            needed = BITS_PER_BYTE * (FORMS[sensor][1].size + CRC_BYTES) * self.rate_hz
            if self.baud < needed:
                raise ConfigError(
                    f"{section}baud is {self.baud}, too slow for {self.rate_hz:g} readings a second; "
                    f"give over {needed:.0f}, or a lower {section}rate_hz"
                )


@dataclass(frozen=True)
class ImuSettings(ReadingsSettings):
    """The IMU, connected by UDP or a serial line; its axes are those of the body."""

    noise: Path | None = None
    """Kalibr's imu.yaml with the noise densities of the IMU."""

    def __post_init__(self) -> None:
        expect_values(self, "imu.")
        expect_ranges(self, "imu.", rate_hz=(10, 5000))
        self._expect_way("imu.", "imu")


@dataclass(frozen=True)
class EncodersSettings(ReadingsSettings):
    """The crane's encoders, connected by UDP or a serial line, and the mounting of the body on the crane."""

    p_crane_body_m: tuple[float, float, float]
    """Position of the body's origin relative to the crane point, in yard axes and metres."""
    R_yard_body: tuple[float, ...]
    """Nominal rotation from body to yard, nine numbers row by row."""
    position_std_m: float
    """Standard deviation of a reading in metres."""

    def __post_init__(self) -> None:
        expect_values(self, "encoders.")
        expect_ranges(
            self, "encoders.", rate_hz=(1, 1000), p_crane_body_m=(-MAX_LEVER_M, MAX_LEVER_M),
            position_std_m=(1e-5, 0.2),
        )  # fmt: skip
        self._expect_way("encoders.", "crane")
        if len(self.R_yard_body) != 9:
            raise ConfigError(f"encoders.R_yard_body has {len(self.R_yard_body)} values; give 9")
        try:
            Pose("yard", "body", np.reshape(self.R_yard_body, (3, 3)), np.zeros(3))
        except ValueError as error:
            raise ConfigError(f"encoders.R_yard_body: {error}; give a rotation, row by row") from None
