"""Draw the conditions under which a yard is recorded: rig, crane, sensors, light, image faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.errors import ConfigError
from barsight.simulation.effects.settings import FaultSettings, LightSettings
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings, SensorSettings
from barsight.simulation.settings.travel import TravelSettings
from barsight.simulation.settings.yard import YardSettings

DRAWN = ("seed", "bars", "yard", "motion", "magnet", "light", "faults")
MOUNTING = ("above_floor_m", "trolley_y_m", "heading_deg", "tilt_deg", "misalignment_deg")
BAR_LENGTH_M = (2.5, 7.0)
ASIDE_M = 1.3
"""Offset of the trolley from the centre of a yard of which a strip is to be hidden, m."""


def draw_conditions(seed: int, given: SimulationSettings, *, hides: bool) -> SimulationSettings:
    """Draw the conditions of a seed; length, frames, images, laser and labels are taken from `given`.

    hides: a strip of the yard is to be out of sight. Raises ConfigError if `given` sets anything that is
    drawn.
    """
    _expect_ordinary(given)
    rng = np.random.default_rng((41, seed))
    aside = float(rng.choice([-1, 1])) * ASIDE_M if hides else float(rng.uniform(-0.4, 0.4))
    camera = replace(
        given.camera,
        above_floor_m=float(rng.uniform(7.0, 8.6)),
        trolley_y_m=aside,
        heading_deg=float(rng.uniform(-8, 8)),
        tilt_deg=float(rng.choice([0.0, rng.uniform(-3, 3)])),
    )
    return replace(
        given,
        seed=seed,
        camera=camera,
        yard=YardSettings(
            bar_length_m=float(rng.uniform(*BAR_LENGTH_M)),
            texture_ratio=float(rng.uniform(0.35, 0.85)),
            label_m=given.yard.label_m,
        ),
        motion=_motion(rng),
        sensors=_sensors(rng, given.sensors),
        light=_light(rng, given.length_m),
        faults=_faults(rng, given.camera.width_px),
    )


def _expect_ordinary(given: SimulationSettings) -> None:
    if given.passes.changes:
        raise ConfigError("simulate: --draw knows no passes.changes; leave one of them out")
    ordinary = SimulationSettings()
    ordinary = replace(ordinary, yard=replace(ordinary.yard, label_m=given.yard.label_m))
    own = [name for name in DRAWN if getattr(given, name) != getattr(ordinary, name)]
    own += [
        f"camera.{name}"
        for name in MOUNTING
        if getattr(given.camera, name) != getattr(CameraSettings(), name)
    ]
    if replace(given.sensors, laser_y_m=ordinary.sensors.laser_y_m) != ordinary.sensors:
        own.append("sensors")
    if own:
        raise ConfigError(f"--draw draws {', '.join(own)}: leave out what sets it")


def _motion(rng: np.random.Generator) -> TravelSettings:
    return TravelSettings(
        speed_mps=float(rng.uniform(0.3, 0.9)),
        acceleration_mps2=float(rng.uniform(0.2, 0.6)),
        sway_deg=float(rng.uniform(0.05, 0.35)),
        sway_hz=float(rng.uniform(0.25, 0.7)),
        vibration_m=float(rng.uniform(0.00002, 0.0001)),
        vibration_hz=float(rng.uniform(7, 14)),
        stops=int(rng.choice([0, 1, 2], p=[0.7, 0.2, 0.1])),
        stop_s=float(rng.uniform(0.5, 4)),
        trolley_m=float(rng.uniform(-0.6, 0.6)) * float(rng.random() < 0.3),
        oscillation_m=_three(0.005 * rng.random(3) ** 2),
        oscillation_hz=_three(np.exp(rng.uniform(np.log(0.3), np.log(3.0), 3))),
        rail_m=float(rng.uniform(0, 0.003)),
        skew_deg=float(rng.uniform(0, 0.05)),
    )


def _three(values: np.ndarray) -> tuple[float, float, float]:
    first, second, third = (float(v) for v in values)
    return first, second, third


def _sensors(rng: np.random.Generator, given: SensorSettings) -> SensorSettings:
    return replace(
        given,
        timeshift_cam_imu_s=float(rng.uniform(-0.005, 0.005)),
        gyro_bias_radps=float(rng.uniform(0.001, 0.01)),
        accel_bias_mps2=float(rng.uniform(0.01, 0.06)),
        encoder_std_m=float(rng.uniform(0.0005, 0.003)),
        encoder_step_m=float(rng.choice([0.0005, 0.001, 0.002])),
        encoder_latency_s=float(rng.choice([0.0, rng.uniform(0, 0.15)])),
        encoder_jitter_s=float(rng.uniform(0, 0.02)),
        encoder_scale=1 + float(rng.normal(0, 2e-4)),
        encoder_backlash_m=float(rng.choice([0.0, rng.uniform(0, 0.004)])),
    )


def _light(rng: np.random.Generator, length_m: float) -> LightSettings:
    x, y = float(rng.uniform(0, 0.7 * length_m)), float(rng.uniform(-3, 1))
    return LightSettings(
        lamp_ratio=float(rng.uniform(0.45, 1.1)),
        ambient=float(rng.uniform(0.3, 0.8)),
        bounce_ratio=float(rng.uniform(0.25, 0.8)),
        lamp_length_m=float(rng.uniform(0.3, 2.0)),
        sun_ratio=float(rng.uniform(0.4, 2.0)) * float(rng.random() < 0.3),
        sun_elevation_deg=float(rng.uniform(25, 65)),
        sun_azimuth_deg=float(rng.uniform(0, 360)),
        sun_patch_m=(x, x + float(rng.uniform(0.8, 3)), y, y + float(rng.uniform(0.8, 3))),
    )


def _faults(rng: np.random.Generator, width_px: int) -> FaultSettings:
    """Draw each fault independently, with its own probability."""

    def some(probability: float, low: float, high: float) -> float:
        return float(rng.uniform(low, high)) * float(rng.random() < probability)

    return FaultSettings(
        exposure_s=some(0.8, 0.001, 0.008),
        haze_ratio=some(0.25, 0.05, 0.3),
        dirt_spots=round(some(0.25, 1, 8)),
        dirt_px=0.02 * width_px,
        drops=round(some(0.15, 1, 4)),
        dead_pixels=round(some(0.3, 5, 60)),
        exposure_step_ratio=some(0.2, 0.03, 0.2),
        flicker_ratio=some(0.25, 0.01, 0.05),
        glare_ratio=some(0.15, 0.05, 0.3),
    )
