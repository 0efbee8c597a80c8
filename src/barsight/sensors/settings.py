"""Settings of the sensors in crane.toml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from barsight.core.errors import ConfigError
from barsight.core.pose import Pose
from barsight.core.settings.values import expect_ranges, expect_values

PORTS = (1, 65535)
MAX_LEVER_M = 30.0


@dataclass(frozen=True)
class CamerasSettings:
    """The two cameras, triggered together, Mono8."""

    serials: tuple[str, str]
    """Serial numbers (DeviceSerialNumber, else DeviceID) of cam0 and cam1."""
    rate_hz: float
    """Pictures a second."""
    exposure_us: float | None = None
    """Time of exposure in microseconds; the camera's own where it isn't given."""
    trigger: str = "free"
    """Line that triggers both cameras, like Line1; `free` leaves the camera's own setting."""
    packet_size_bytes: int = 8000
    """Payload of a packet; over 1500 the network must carry jumbo frames (MTU 9000)."""
    interface: str | None = None
    """Name or IPv4 address of the host's interface to the cameras; all are searched where it isn't given.

    The driver `pylon` searches all.
    """
    driver: Literal["gige", "pylon"] = "gige"
    """`gige`: GigE Vision of any make, extra `cameras`. `pylon`: Basler's, by GigE or USB, extra `basler`."""

    def __post_init__(self) -> None:
        expect_values(self, "cameras.")
        expect_ranges(
            self, "cameras.", rate_hz=(0.5, 200), exposure_us=(5, 200_000), packet_size_bytes=(500, 16000)
        )
        if self.serials[0] == self.serials[1]:
            raise ConfigError(f"cameras.serials names {self.serials[0]} twice; give cam0's and cam1's")


@dataclass(frozen=True)
class ImuSettings:
    """The IMU, by UDP; its axes are the body's."""

    port: int
    """UDP port that its datagrams come to."""
    rate_hz: float
    """Readings a second."""
    noise: Path | None = None
    """Kalibr's imu.yaml with its noise densities."""

    def __post_init__(self) -> None:
        expect_values(self, "imu.")
        expect_ranges(self, "imu.", port=PORTS, rate_hz=(10, 5000))


@dataclass(frozen=True)
class EncodersSettings:
    """The crane's encoders, by UDP, and how the body hangs on the crane."""

    port: int
    """UDP port that their datagrams come to."""
    rate_hz: float
    """Readings a second."""
    p_crane_body_m: tuple[float, float, float]
    """The body's origin minus the crane point, yard axes, in metres."""
    R_yard_body: tuple[float, ...]
    """Nominal rotation, nine numbers row by row."""
    position_std_m: float
    """Sigma of a reading in metres."""

    def __post_init__(self) -> None:
        expect_values(self, "encoders.")
        expect_ranges(
            self, "encoders.", port=PORTS, rate_hz=(1, 1000), p_crane_body_m=(-MAX_LEVER_M, MAX_LEVER_M),
            position_std_m=(1e-5, 0.2),
        )  # fmt: skip
        if len(self.R_yard_body) != 9:
            raise ConfigError(f"encoders.R_yard_body has {len(self.R_yard_body)} values; give 9")
        try:
            Pose("yard", "body", np.reshape(self.R_yard_body, (3, 3)), np.zeros(3))
        except ValueError as error:
            raise ConfigError(f"encoders.R_yard_body: {error}; give a rotation, row by row") from None
