"""Define the settings of a simulated recording: one frozen dataclass, checked once, units in the names."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from barsight.core.errors import ConfigError
from barsight.core.settings.values import expect_values
from barsight.simulation.effects.settings import FaultSettings, LightSettings

BARS_OF_RINGS = (1, 7, 19, 37, 61)


@dataclass(frozen=True)
class BarKind:
    """One kind of bundle: the bars' diameter (m) and how many lie in a bundle (1, 7, 19, 37 or 61)."""

    diameter_m: float
    count: int

    @property
    def rings(self) -> int:
        """Return the rings of bars around the middle one."""
        return BARS_OF_RINGS.index(self.count)


def parse_bars(text: str) -> tuple[BarKind, ...]:
    """Parse `"90mm:7,40mm:37"` to kinds of bundles. Raises ConfigError where it can't be read."""
    kinds = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*mm\s*:\s*(\d+)\s*", part)
        if match is None:
            raise ConfigError(
                f"bars {text!r}: {part!r} is not like 90mm:7; give diameter and bars per bundle"
            )
        kind = BarKind(float(match[1]) / 1000, int(match[2]))
        if kind.count not in BARS_OF_RINGS:
            raise ConfigError(f"bars {text!r}: a bundle packs 1, 7, 19, 37 or 61 bars, not {kind.count}")
        if not 0.01 <= kind.diameter_m <= 0.5:
            raise ConfigError(f"bars {text!r}: the diameter must lie between 10 and 500 mm")
        kinds.append(kind)
    return tuple(kinds)


@dataclass(frozen=True)
class CameraSettings:
    """Stereo pair and its mounting under the crane."""

    width_px: int = 1280
    """Image width."""
    height_px: int = 1024
    """Image height."""
    focal_px: float = 1250.0
    """Focal length of cam0; cam1's differs by 0.2 %."""
    baseline_m: float = 0.5
    """Distance between the cameras."""
    misalignment_deg: float = 0.3
    """Standard deviation of the cameras' mounting angles, drawn from the seed."""
    distortion: tuple[float, float, float, float] = (-0.06, 0.02, 0.0003, -0.0002)
    """Radial-tangential coefficients k1 k2 p1 p2 of both lenses; 0 0 0 0 switches them off."""
    above_floor_m: float = 8.0
    """Height of the body over the floor."""
    trolley_y_m: float = 0.15
    """Place of the body across the travel."""
    heading_deg: float = 4.0
    """Turn of the rig about the vertical: 0 has the baseline along the travel."""
    tilt_deg: float = 0.0
    """Turn of the optical axis about the baseline: 0 looks straight down."""
    samples_per_side: int = 2
    """Rays per pixel and side; 2 means four rays a pixel."""
    psf_sigma_px: float = 0.45
    """Blur of lens and pixel."""
    vignetting: float = 0.25
    """Loss of light in the corners, as a share."""
    cam1_gain: float = 0.95
    """Exposure of cam1 relative to cam0."""
    shot_noise_dn: float = 0.18
    """Shot noise of one gray level; it grows with the root of the signal."""
    read_noise_dn: float = 0.9
    """Noise that doesn't depend on the signal, in gray levels."""

    def __post_init__(self) -> None:
        _expect(min(self.width_px, self.height_px) >= 64, "camera width and height must be at least 64 px")
        _expect(max(self.width_px, self.height_px) <= 8192, "camera width and height end at 8192 px")
        _expect(self.focal_px > 0.3 * self.width_px, "camera focal_px must be over 0.3 of the width")
        _expect(0.01 <= self.baseline_m <= 3, "camera baseline_m must lie between 0.01 and 3 m")
        _expect(1 <= self.samples_per_side <= 4, "camera samples_per_side must lie between 1 and 4")
        _expect(0 <= self.vignetting < 1, "camera vignetting must lie between 0 and 1")
        _expect(0 <= self.misalignment_deg <= 2, "camera misalignment_deg must lie between 0 and 2")
        _expect(abs(self.tilt_deg) <= 30, "camera tilt_deg must lie within 30 degrees")
        _expect(
            min(self.shot_noise_dn, self.read_noise_dn, self.psf_sigma_px) >= 0,
            "camera noises and blur can't be negative",
        )


@dataclass(frozen=True)
class YardSettings:
    """The stack: bundles side by side along X, bars along Y."""

    max_layers: int = 4
    """Layers of bundles at the highest place."""
    bar_length_m: float = 7.5
    """Length of the bars; some sections hold shorter ones."""
    gap_m: float = 0.02
    """Mean clearance between neighbouring bundles, over what their skew needs."""
    skew_deg: float = 0.3
    """Standard deviation of the bundles' yaw; they stay within 1 degree, or within twice this."""
    uneven_ends_m: float = 0.03
    """How far the ends of a bundle's bars stand apart."""
    missing_ratio: float = 0.08
    """Share of places on the lowest layer that are empty (gullies)."""
    crossed_ratio: float = 0.0
    """Share of sections with a bundle lying across the others, or over them turned by 6 to 20 degrees."""
    dunnage_m: float = 0.09
    """Height and width of the wooden beams between the layers."""
    strap_spacing_m: float = 1.7
    """Distance between a bundle's straps; 0 leaves them out."""
    ribbed_ratio: float = 0.25
    """Share of sections that hold ribbed bars."""
    gloss: float = 1.0
    """Strength of the highlights; 0 is matt steel."""
    texture_ratio: float = 1.0
    """Contrast of the surfaces' texture, steel's and the floor's, over the ordinary."""

    def __post_init__(self) -> None:
        _expect(1 <= self.max_layers <= 5, "yard max_layers must lie between 1 and 5")
        _expect(1 <= self.bar_length_m <= 20, "yard bar_length_m must lie between 1 and 20 m")
        _expect(0 <= self.skew_deg <= 2, "yard skew_deg must lie between 0 and 2")
        _expect(0 <= self.missing_ratio <= 0.6, "yard missing_ratio must lie between 0 and 0.6")
        _expect(0 <= self.crossed_ratio <= 1, "yard crossed_ratio must lie between 0 and 1")
        _expect(0.02 <= self.dunnage_m <= 0.3, "yard dunnage_m must lie between 0.02 and 0.3 m")
        _expect(0 <= self.ribbed_ratio <= 1, "yard ribbed_ratio must lie between 0 and 1")
        _expect(0 <= self.gap_m <= 1, "yard gap_m must lie between 0 and 1 m")
        _expect(0 <= self.uneven_ends_m <= 0.5, "yard uneven_ends_m must lie between 0 and 0.5 m")
        _expect(self.gloss >= 0, "yard gloss can't be negative")
        _expect(0 <= self.texture_ratio <= 2, "yard texture_ratio must lie between 0 and 2")
        _expect(
            self.strap_spacing_m == 0 or self.strap_spacing_m >= 0.3,
            "yard strap_spacing_m must be 0 or at least 0.3 m",
        )


@dataclass(frozen=True)
class TravelSettings:
    """Travel of the crane along X."""

    speed_mps: float = 0.6
    """Speed of the bridge between accelerating and braking."""
    acceleration_mps2: float = 0.35
    """Highest acceleration and braking."""
    standstill_s: float = 2.0
    """Time at rest before the start and after the end."""
    overrun_m: float = 0.6
    """How far the travel begins before the stack and ends behind it."""
    sway_deg: float = 0.15
    """Amplitude of the body's swing."""
    sway_hz: float = 0.4
    """Frequency of the swing."""
    vibration_m: float = 0.00004
    """Amplitude of the vibration."""
    vibration_hz: float = 9.0
    """Frequency of the vibration."""
    stops: int = 0
    """Times that the crane stops under way, at places drawn from the seed."""
    stop_s: float = 2.0
    """Time of a stop, from standing still to starting anew."""
    trolley_m: float = 0.0
    """How far the trolley travels during the pass."""
    oscillation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Amplitudes of bridge, trolley and hoist on their springs, which their encoders don't see."""
    oscillation_hz: tuple[float, float, float] = (0.7, 1.1, 1.9)
    """Frequencies of these."""
    rail_m: float = 0.0
    """Amplitude by which the rails rise and fall and lead aside, with a wave every few metres."""
    skew_deg: float = 0.0
    """Amplitude by which the bridge skews as it travels."""

    def __post_init__(self) -> None:
        _expect(0.01 <= self.speed_mps <= 5, "motion speed_mps must lie between 0.01 and 5")
        _expect(0.01 <= self.acceleration_mps2 <= 10, "motion acceleration_mps2 must lie between 0.01 and 10")
        _expect(1 <= self.standstill_s <= 120, "motion standstill_s must lie between 1 and 120")
        _expect(0 <= self.overrun_m <= 5, "motion overrun_m must lie between 0 and 5 m")
        _expect(0 <= self.sway_deg <= 5, "motion sway_deg must lie between 0 and 5")
        _expect(0 <= self.vibration_m <= 0.01, "motion vibration_m must lie between 0 and 0.01")
        hertz = (self.sway_hz, self.vibration_hz, *self.oscillation_hz)
        _expect(min(hertz) > 0, "motion frequencies must be positive")
        _expect(0 <= self.stops <= 20, "motion stops must lie between 0 and 20")
        _expect(0 <= self.stop_s <= 600, "motion stop_s must lie between 0 and 600")
        _expect(abs(self.trolley_m) <= 20, "motion trolley_m must lie within 20 m")
        _expect(
            0 <= min(self.oscillation_m) <= max(self.oscillation_m) <= 0.1,
            "motion oscillation_m must lie between 0 and 0.1 m",
        )
        _expect(0 <= self.rail_m <= 0.05, "motion rail_m must lie between 0 and 0.05 m")
        _expect(0 <= self.skew_deg <= 2, "motion skew_deg must lie between 0 and 2")


@dataclass(frozen=True)
class SensorSettings:
    """IMU, encoders, laser and the clocks."""

    timeshift_cam_imu_s: float = -0.0035
    """t_imu = t_cam + timeshift (Kalibr)."""
    imu_rate_hz: int = 200
    """Samples of the IMU per second."""
    gyro_noise_density: float = 2.4e-4
    """rad/s/sqrt(Hz)."""
    gyro_random_walk: float = 2.0e-5
    """rad/s^2/sqrt(Hz)."""
    gyro_bias_radps: float = 0.006
    """Standard deviation of the bias at the start."""
    accel_noise_density: float = 1.9e-3
    """m/s^2/sqrt(Hz)."""
    accel_random_walk: float = 4.0e-4
    """m/s^3/sqrt(Hz)."""
    accel_bias_mps2: float = 0.04
    """Standard deviation of the bias at the start."""
    encoder_rate_hz: int = 20
    """Readings of the crane's encoders per second."""
    encoder_std_m: float = 0.0015
    """Noise of one reading."""
    encoder_step_m: float = 0.001
    """Quantisation of a reading."""
    encoder_latency_s: float = 0.0
    """A reading stamped t says where the crane was at t minus this."""
    encoder_jitter_s: float = 0.0
    """How much later still a reading may be, evenly between 0 and this."""
    encoder_scale: float = 1.0
    """A metre of the bridge as its encoder reads it."""
    encoder_backlash_m: float = 0.0
    """Play between bridge and encoder: it reads the middle of it, and follows at its end."""
    laser_std_m: float = 0.001
    """Noise of a laser point."""
    laser_y_m: tuple[float, ...] = (0.45, -1.15)
    """Where the laser's profiles lie across the travel; none leaves the laser out."""

    def __post_init__(self) -> None:
        _expect(abs(self.timeshift_cam_imu_s) <= 0.5, "sensors timeshift_cam_imu_s must lie within 0.5 s")
        _expect(20 <= self.imu_rate_hz <= 2000, "sensors imu_rate_hz must lie between 20 and 2000")
        _expect(1 <= self.encoder_rate_hz <= 1000, "sensors encoder_rate_hz must lie between 1 and 1000")
        _expect(0 <= self.encoder_step_m <= 0.1, "sensors encoder_step_m must lie between 0 and 0.1 m")
        latest = self.encoder_latency_s + self.encoder_jitter_s
        _expect(
            min(self.encoder_latency_s, self.encoder_jitter_s) >= 0 and latest <= 0.9,
            "sensors encoder_latency_s and encoder_jitter_s must lie between 0 and 0.9 s together",
        )
        _expect(0.9 <= self.encoder_scale <= 1.1, "sensors encoder_scale must lie between 0.9 and 1.1")
        _expect(
            0 <= self.encoder_backlash_m <= 0.1, "sensors encoder_backlash_m must lie between 0 and 0.1 m"
        )
        noises = (
            self.gyro_noise_density, self.gyro_random_walk, self.gyro_bias_radps, self.accel_noise_density,
            self.accel_random_walk, self.accel_bias_mps2, self.encoder_std_m, self.laser_std_m,
        )  # fmt: skip
        _expect(min(noises) >= 0, "sensors noises can't be negative")
        _expect(all(abs(y) <= 3.7 for y in self.laser_y_m), "sensors laser_y_m must lie within 3.7 m")


@dataclass(frozen=True)
class MagnetSettings:
    """A magnet's plate that hangs from the crane into the pictures, for a part of the travel."""

    size_m: tuple[float, float] = (0.0, 0.0)
    """Along the travel and across; 0 0 leaves it out."""
    below_body_m: float = 3.0
    """How far it hangs under the body."""
    offset_m: tuple[float, float] = (0.6, 0.3)
    """Where its middle hangs from the body, along the travel and across."""
    first_ratio: float = 0.3
    """Share of the frames from which it hangs there."""
    last_ratio: float = 0.6
    """Share of the frames until which it hangs there."""

    def __post_init__(self) -> None:
        _expect(min(self.size_m) >= 0, "magnet size_m can't be negative")
        _expect(self.below_body_m > 0.2, "magnet below_body_m must be over 0.2 m")
        _expect(0 <= self.first_ratio <= self.last_ratio <= 1, "magnet shares must rise within 0 and 1")


@dataclass(frozen=True)
class SimulationSettings:
    """A simulated recording of a bar yard. The same settings give the same bytes."""

    length_m: Annotated[float, tyro.conf.arg(aliases=("--length",))] = 7.0
    """Length of the stack along the travel."""
    frames: int = 20
    """Stereo pairs, spread evenly over the travel."""
    seed: int = 0
    """Seed of everything that is drawn by chance."""
    bars: str = "90mm:7"
    """Kinds of bundles, diameter and bars: 90mm:7,40mm:37; each section of the stack takes one."""
    depth_views: int = 2
    """Pairs whose true depth is stored."""
    camera: CameraSettings = field(default_factory=CameraSettings)
    yard: YardSettings = field(default_factory=YardSettings)
    motion: TravelSettings = field(default_factory=TravelSettings)
    sensors: SensorSettings = field(default_factory=SensorSettings)
    magnet: MagnetSettings = field(default_factory=MagnetSettings)
    light: LightSettings = field(default_factory=LightSettings)
    faults: FaultSettings = field(default_factory=FaultSettings)

    def __post_init__(self) -> None:
        expect_values(self)
        _expect(1 <= self.length_m <= 500, "length_m must lie between 1 and 500 m")
        _expect(2 <= self.frames <= 100_000, "frames must lie between 2 and 100000")
        _expect(self.seed >= 0, "seed can't be negative")
        _expect(0 <= self.depth_views <= self.frames, "depth_views must lie between 0 and frames")
        layers = self.yard.max_layers + (self.yard.crossed_ratio > 0)
        tallest = max(2 * k.diameter_m * (k.rings + 0.5) for k in self.kinds) + self.yard.dunnage_m
        _expect(
            self.camera.above_floor_m > layers * tallest + 1,
            "camera above_floor_m must be at least 1 m over the highest possible stack",
        )

    @property
    def kinds(self) -> tuple[BarKind, ...]:
        """Parse the kinds of bundles that `bars` names."""
        return parse_bars(self.bars)

    @classmethod
    def demo(cls) -> SimulationSettings:
        """Make a small yard for `barsight demo`: 3 m of stack, 10 pairs of 640x512."""
        camera = CameraSettings(width_px=640, height_px=512, focal_px=625.0)
        return cls(
            length_m=3.0, frames=10, seed=1, camera=camera, yard=YardSettings(max_layers=3, bar_length_m=5.0)
        )


def _expect(holds: bool, sentence: str) -> None:
    if not holds:
        raise ConfigError(sentence)
