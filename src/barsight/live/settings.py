"""Settings of `barsight live` beyond those of measuring."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.settings.values import expect_ranges, expect_values


@dataclass(frozen=True)
class LiveSettings:
    """The run beside the crane."""

    ring_pairs: int = 8
    """Pairs that the ring in shared memory holds: 2.6 MB each at 1280x1024."""
    keyframe_way_m: float = 0.1
    """A pair becomes a keyframe, which is kept and mapped, where the body has gone so far since the last."""
    still_pairs: int = 5
    """So many pairs of a crane that stands are kept too, `passed_every_s` apart: they fix where it begins."""
    passed_every_s: float = 0.2
    """Of pairs that tracking passes over for a newer one, those so far apart are kept without a pose."""
    imu_silence_s: float = 0.2
    """An IMU without readings for so long is out."""
    encoder_silence_s: float = 0.3
    """Encoders without readings for so long are out."""
    camera_silence_intervals: float = 2.5
    """A camera without pictures for so many of its intervals, at least 0.3 s, is out."""
    hang_s: float = 30.0
    """A process that hasn't gone round its loop for so long hangs: it is ended and started anew."""
    health_every_s: float = 1.0
    """Interval between writings of health.json and health.prom."""

    def __post_init__(self) -> None:
        expect_values(self, "live.")
        expect_ranges(
            self, "live.", ring_pairs=(2, 1000), keyframe_way_m=(0, 10), still_pairs=(0, 1000),
            passed_every_s=(0, 60), imu_silence_s=(0.02, 10), encoder_silence_s=(0.02, 10),
            camera_silence_intervals=(1.5, 100), hang_s=(1, 3600),
            health_every_s=(0.1, 60),
        )  # fmt: skip
