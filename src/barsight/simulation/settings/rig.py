"""Define the settings of the simulated cameras and the other sensors."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.settings.values import NOT_NEGATIVE, UNDER_1, expect, expect_ranges


@dataclass(frozen=True)
class CameraSettings:
    """Stereo cameras and their mounting under the crane."""

    width_px: int = 1280
    """Width of the images."""
    height_px: int = 1024
    """Height of the images."""
    focal_px: float = 1250.0
    """Focal length of cam0; that of cam1 is 0.2 % longer."""
    baseline_m: float = 0.5
    """Distance between the cameras."""
    misalignment_deg: float = 0.3
    """Standard deviation of cam1's mounting angles relative to cam0; that of cam0's relative to the body
    is twice as large.
    """
    rig_seed: int | None = None
    """Seed of the rig, to be the same for recordings of one crane; by default the seed of everything else."""
    distortion: tuple[float, float, float, float] = (-0.06, 0.02, 0.0003, -0.0002)
    """Radial-tangential coefficients k1 k2 p1 p2 of both lenses; 0 0 0 0 switches distortion off."""
    above_floor_m: float = 8.0
    """Height of the body above the floor."""
    trolley_y_m: float = 0.15
    """Position of the body across the travel."""
    aside_m: float = 0.0
    """Offset of both cameras on the body, across the travel; to simulate a second pair on the same body,
    make another recording that differs only in this.
    """
    heading_deg: float = 4.0
    """Rotation of the rig about the vertical; with 0 the baseline is along the travel."""
    tilt_deg: float = 0.0
    """Rotation of the optical axis about the baseline; with 0 it points straight down."""
    samples_per_side: int = 2
    """Rays per pixel in each direction; 2 means four rays per pixel."""
    psf_sigma_px: float = 0.45
    """Sigma of the blur by lens and pixel."""
    vignetting: float = 0.25
    """Share of the light lost in the image corners."""
    cam1_gain: float = 0.95
    """Exposure of cam1 relative to cam0."""
    shot_noise_dn: float = 0.18
    """Standard deviation of the shot noise at a signal of one gray level; it grows with the root of the
    signal.
    """
    read_noise_dn: float = 0.9
    """Standard deviation of the noise that doesn't depend on the signal, in gray levels."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "camera.", width_px=(64, 8192), height_px=(64, 8192), baseline_m=(0.01, 3),
            aside_m=(-20, 20),
            samples_per_side=(1, 4), vignetting=(0, UNDER_1), misalignment_deg=(0, 2), tilt_deg=(-30, 30),
            shot_noise_dn=NOT_NEGATIVE, read_noise_dn=NOT_NEGATIVE, psf_sigma_px=NOT_NEGATIVE,
            rig_seed=NOT_NEGATIVE,
        )  # fmt: skip
        expect(self.focal_px > 0.3 * self.width_px, "camera.focal_px must be over 0.3 of the width")


@dataclass(frozen=True)
class SensorSettings:
    """IMU, encoders, laser and clock offset."""

    timeshift_cam_imu_s: float = -0.0035
    """Offset of the IMU's clock: t_imu = t_cam + timeshift (Kalibr)."""
    imu_rate_hz: int = 200
    """Samples of the IMU per second."""
    gyro_noise_density: float = 2.4e-4
    """Noise density of the gyro, rad/s/sqrt(Hz)."""
    gyro_random_walk: float = 2.0e-5
    """Random walk of the gyro's bias, rad/s^2/sqrt(Hz)."""
    gyro_bias_radps: float = 0.006
    """Standard deviation of the gyro's bias at the start."""
    accel_noise_density: float = 1.9e-3
    """Noise density of the accelerometer, m/s^2/sqrt(Hz)."""
    accel_random_walk: float = 4.0e-4
    """Random walk of the accelerometer's bias, m/s^3/sqrt(Hz)."""
    accel_bias_mps2: float = 0.04
    """Standard deviation of the accelerometer's bias at the start."""
    encoder_rate_hz: int = 20
    """Readings of the crane's encoders per second."""
    encoder_std_m: float = 0.0015
    """Standard deviation of an encoder reading's noise."""
    encoder_step_m: float = 0.001
    """Quantisation step of an encoder reading; 0 switches it off."""
    encoder_latency_s: float = 0.0
    """Latency of the encoders: a reading stamped t gives the position at t minus this."""
    encoder_jitter_s: float = 0.0
    """Largest jitter on top of the latency; it is uniformly distributed from 0 to this."""
    encoder_scale: float = 1.0
    """Scale of the bridge's encoder: metres read per metre travelled."""
    encoder_backlash_m: float = 0.0
    """Backlash between bridge and encoder, centred at the start."""
    laser_std_m: float = 0.001
    """Standard deviation of a laser point's noise."""
    laser_y_m: tuple[float, ...] = (0.45, -1.15)
    """y of each laser profile; with none the laser is left out."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "sensors.", timeshift_cam_imu_s=(-0.5, 0.5), imu_rate_hz=(20, 2000),
            encoder_rate_hz=(1, 1000), encoder_step_m=(0, 0.1), encoder_scale=(0.9, 1.1),
            encoder_backlash_m=(0, 0.1), laser_y_m=(-3.7, 3.7), gyro_noise_density=NOT_NEGATIVE,
            gyro_random_walk=NOT_NEGATIVE, gyro_bias_radps=NOT_NEGATIVE, accel_noise_density=NOT_NEGATIVE,
            accel_random_walk=NOT_NEGATIVE, accel_bias_mps2=NOT_NEGATIVE, encoder_std_m=NOT_NEGATIVE,
            laser_std_m=NOT_NEGATIVE, encoder_latency_s=(0, 0.9), encoder_jitter_s=(0, 0.9),
        )  # fmt: skip
        expect(
            self.encoder_latency_s + self.encoder_jitter_s <= 0.9,
            "sensors.encoder_latency_s and encoder_jitter_s must lie in 0...0.9 together",
        )
