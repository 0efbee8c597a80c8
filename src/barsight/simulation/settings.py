"""Define the settings of a simulated recording: one frozen dataclass, checked once, units in the names."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from math import inf
from typing import Annotated, Literal

import tyro

from barsight.core.errors import ConfigError
from barsight.core.settings.values import NOT_NEGATIVE, POSITIVE, SHARE, UNDER_1, expect_ranges, expect_values
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
    rig_seed: int | None = None
    """Seed of the rig, the same for recordings of one crane; by default that of all else."""
    distortion: tuple[float, float, float, float] = (-0.06, 0.02, 0.0003, -0.0002)
    """Radial-tangential coefficients k1 k2 p1 p2 of both lenses; 0 0 0 0 switches them off."""
    above_floor_m: float = 8.0
    """Height of the body over the floor."""
    trolley_y_m: float = 0.15
    """Place of the body across the travel."""
    aside_m: float = 0.0
    """Place of both cameras in the body, across the travel: a second pair on the same body is a recording of
    its own, all else alike."""
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
        expect_ranges(
            self, "camera.", width_px=(64, 8192), height_px=(64, 8192), baseline_m=(0.01, 3),
            aside_m=(-20, 20),
            samples_per_side=(1, 4), vignetting=(0, UNDER_1), misalignment_deg=(0, 2), tilt_deg=(-30, 30),
            shot_noise_dn=NOT_NEGATIVE, read_noise_dn=NOT_NEGATIVE, psf_sigma_px=NOT_NEGATIVE,
        )  # fmt: skip
        _expect(self.focal_px > 0.3 * self.width_px, "camera.focal_px must be over 0.3 of the width")


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
    """Largest shift of a bar along its bundle, either way."""
    missing_ratio: float = 0.08
    """Share of places on the lowest layer that are empty (gullies)."""
    crossed_ratio: float = 0.0
    """Share of sections with a bundle lying across the others, or over them turned by 6 to 20 degrees."""
    dunnage_m: float = 0.09
    """Height and width of the wooden beams between the layers."""
    strap_spacing_m: float = 1.7
    """Distance between a bundle's straps; 0 leaves them out."""
    label_m: tuple[float, float] = (0.0, 0.0)
    """Length and width of a label with a QR code of its own on each strapped bundle, over the middle strap;
    0 0 leaves a small plain one there."""
    ribbed_ratio: float = 0.25
    """Share of sections that hold ribbed bars."""
    gloss: float = 1.0
    """Strength of the highlights; 0 is matt steel."""
    texture_ratio: float = 1.0
    """Contrast of the surfaces' texture, steel's and the floor's, over the ordinary."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "yard.", max_layers=(1, 5), bar_length_m=(1, 20), skew_deg=(0, 2), missing_ratio=(0, 0.6),
            crossed_ratio=SHARE, dunnage_m=(0.02, 0.3), ribbed_ratio=SHARE, gap_m=(0, 1),
            uneven_ends_m=(0, 0.5), label_m=(0, 0.6), gloss=NOT_NEGATIVE, texture_ratio=(0, 2),
        )  # fmt: skip
        _expect((min(self.label_m) == 0) == (max(self.label_m) == 0), "yard.label_m needs both sizes, or 0 0")
        _expect(
            self.strap_spacing_m == 0 or self.strap_spacing_m >= 0.3,
            "yard.strap_spacing_m must be 0 or at least 0.3",
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
    """Travel beyond either end of the stack."""
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
    """Duration of a stop."""
    trolley_m: float = 0.0
    """Travel of the trolley during the pass."""
    backward: bool = False
    """Whether the bridge travels from high X to low X."""
    begin_s: float = 0.0
    """Time after the simulation's epoch at which the recording begins."""
    oscillation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Amplitudes at which bridge, trolley and hoist oscillate, unseen by their encoders."""
    oscillation_hz: tuple[float, float, float] = (0.7, 1.1, 1.9)
    """Frequencies of these oscillations."""
    rail_m: float = 0.0
    """Amplitude of the rails' errors in height and straightness, with a wave every few metres."""
    skew_deg: float = 0.0
    """Amplitude by which the bridge skews as it travels."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "motion.", speed_mps=(0.01, 5), acceleration_mps2=(0.01, 10), standstill_s=(1, 120),
            overrun_m=(0, 5), sway_deg=(0, 5), vibration_m=(0, 0.01), sway_hz=POSITIVE,
            vibration_hz=POSITIVE, oscillation_hz=POSITIVE, stops=(0, 20), stop_s=(0, 600),
            trolley_m=(-20, 20), begin_s=(0, 1e8), oscillation_m=(0, 0.1), rail_m=(0, 0.05), skew_deg=(0, 2),
        )  # fmt: skip


@dataclass(frozen=True)
class GirderSettings:
    """Bending of girder and rails, and a girder out of square: no encoder sees it."""

    deflection_m: float = 0.0
    """Deflection of the girder with the trolley in its middle: a parabola, 0 at its ends."""
    ends_y_m: tuple[float, float] = (-10.0, 10.0)
    """The crane point's Y with the trolley at either end of the girder."""
    skew_mm_per_m: float = 0.0
    """Skew of the girder against square to the rails: shift along X for a metre of the trolley's way."""
    rail_m: float = 0.0
    """Sag of the rails in their middle against their ends: a parabola."""
    rail_ends_x_m: tuple[float, float] = (-10.0, 30.0)
    """The crane point's X with the bridge at either end of the rails."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "girder.", deflection_m=(-0.1, 0.1), skew_mm_per_m=(-10, 10), rail_m=(-0.1, 0.1),
            ends_y_m=(-200, 200), rail_ends_x_m=(-1000, 1000),
        )  # fmt: skip
        spans = [high - low for low, high in (self.ends_y_m, self.rail_ends_x_m)]
        _expect(
            min(spans) >= 1, "girder.ends_y_m and rail_ends_x_m must be 1 m or more apart, the lower first"
        )


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
    """Latency: a reading stamped t gives the position at t minus this."""
    encoder_jitter_s: float = 0.0
    """Jitter on top of the latency, uniform between 0 and this."""
    encoder_scale: float = 1.0
    """Scale of the bridge's encoder: metres read per metre travelled."""
    encoder_backlash_m: float = 0.0
    """Backlash between bridge and encoder, centred at the start."""
    laser_std_m: float = 0.001
    """Noise of a laser point."""
    laser_y_m: tuple[float, ...] = (0.45, -1.15)
    """y of the laser's profiles; none leaves the laser out."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "sensors.", timeshift_cam_imu_s=(-0.5, 0.5), imu_rate_hz=(20, 2000),
            encoder_rate_hz=(1, 1000), encoder_step_m=(0, 0.1), encoder_scale=(0.9, 1.1),
            encoder_backlash_m=(0, 0.1), laser_y_m=(-3.7, 3.7), gyro_noise_density=NOT_NEGATIVE,
            gyro_random_walk=NOT_NEGATIVE, gyro_bias_radps=NOT_NEGATIVE, accel_noise_density=NOT_NEGATIVE,
            accel_random_walk=NOT_NEGATIVE, accel_bias_mps2=NOT_NEGATIVE, encoder_std_m=NOT_NEGATIVE,
            laser_std_m=NOT_NEGATIVE, encoder_latency_s=(0, 0.9), encoder_jitter_s=(0, 0.9),
        )  # fmt: skip
        _expect(
            self.encoder_latency_s + self.encoder_jitter_s <= 0.9,
            "sensors.encoder_latency_s and encoder_jitter_s must lie in 0...0.9 together",
        )


@dataclass(frozen=True)
class PassesSettings:
    """Several passes over one yard, in time's order; OUT then holds a recording for each: pass_1, pass_2."""

    trolley_y_m: tuple[float, ...] = ()
    """Place of the body across the travel in each pass; none makes OUT a single recording."""
    alternate: bool = True
    """Every second pass travels back, from high X to low X."""
    pause_s: float = 120.0
    """Time from one pass's end to the next one's begin."""
    changes: tuple[Literal["taken", "added", "moved"], ...] = ()
    """What happens before the last pass to bundles on top, to one each: it is taken away, only comes then, or
    is moved half a metre along itself."""

    def __post_init__(self) -> None:
        expect_ranges(self, "passes.", trolley_y_m=(-50, 50), pause_s=(0, 1e6))
        _expect(not self.changes or len(self.trolley_y_m) > 1, "passes.changes needs two passes or more")


@dataclass(frozen=True)
class MagnetSettings:
    """A magnet's plate that hangs from the crane into the pictures, for a part of the travel."""

    size_m: tuple[float, float] = (0.0, 0.0)
    """Along the travel and across; 0 0 leaves it out."""
    below_body_m: float = 3.0
    """Distance below the body."""
    offset_m: tuple[float, float] = (0.6, 0.3)
    """Its middle relative to the body, along the travel and across."""
    first_ratio: float = 0.3
    """Share of the frames after which it appears."""
    last_ratio: float = 0.6
    """Share of the frames after which it disappears."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "magnet.", size_m=NOT_NEGATIVE, below_body_m=(0.2, inf), first_ratio=SHARE, last_ratio=SHARE
        )
        _expect(self.first_ratio <= self.last_ratio, "magnet.first_ratio can't be over magnet.last_ratio")


@dataclass(frozen=True)
class SimulationSettings:
    """A simulated recording of a bar yard. The same settings give the same bytes."""

    length_m: Annotated[float, tyro.conf.arg(aliases=("--length",))] = 7.0
    """Length of the stack along the travel."""
    frames: int = 20
    """Stereo pairs, spread evenly over the travel."""
    seed: int = 0
    """Random seed."""
    bars: str = "90mm:7"
    """Kinds of bundles, diameter and bars: 90mm:7,40mm:37; each section of the stack takes one."""
    depth_views: int = 2
    """Pairs whose true depth is stored."""
    camera: CameraSettings = field(default_factory=CameraSettings)
    yard: YardSettings = field(default_factory=YardSettings)
    motion: TravelSettings = field(default_factory=TravelSettings)
    girder: GirderSettings = field(default_factory=GirderSettings)
    sensors: SensorSettings = field(default_factory=SensorSettings)
    passes: PassesSettings = field(default_factory=PassesSettings)
    magnet: MagnetSettings = field(default_factory=MagnetSettings)
    light: LightSettings = field(default_factory=LightSettings)
    faults: FaultSettings = field(default_factory=FaultSettings)

    def __post_init__(self) -> None:
        expect_values(self)
        expect_ranges(
            self, "", length_m=(1, 500), frames=(2, 100_000), seed=NOT_NEGATIVE, depth_views=(0, self.frames)
        )
        layers = self.yard.max_layers + (self.yard.crossed_ratio > 0)
        tallest = max(2 * k.diameter_m * (k.rings + 0.5) for k in self.kinds) + self.yard.dunnage_m
        _expect(
            self.camera.above_floor_m > layers * tallest + 1,
            "camera.above_floor_m must be at least 1 m over the highest possible stack",
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
