"""Define the crane's motion as exact functions of time: travel with acceleration and braking, stops, sway,
vibration, oscillation on springs, uneven rails.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from barsight.core.arrays import Float64
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.travel import GirderSettings, TravelSettings

SMOOTHSTEP_PEAK_SLOPE = 1.875
CRANE_TO_BODY_M = (0.35, -0.2, -0.55)
RAIL_WAVE_M = (3.7, 5.3)
"""Wavelengths of the rails' errors, m: vertical and lateral."""
SKEW_WAVE_M = 6.1
RAILS = 14
"""Index of the first phase that belongs to the rails."""


@dataclass(frozen=True, eq=False)
class Jet:
    """A function of time with its first and second derivative, each (N,); products follow Leibniz's rule."""

    value: Float64
    rate: Float64
    rate2: Float64

    def __add__(self, other: Jet) -> Jet:
        return Jet(self.value + other.value, self.rate + other.rate, self.rate2 + other.rate2)

    def __mul__(self, other: Jet) -> Jet:
        return Jet(
            self.value * other.value,
            self.rate * other.value + self.value * other.rate,
            self.rate2 * other.value + 2 * self.rate * other.rate + self.value * other.rate2,
        )

    def scaled(self, factor: float) -> Jet:
        """Scale by a constant."""
        return Jet(factor * self.value, factor * self.rate, factor * self.rate2)

    def shifted(self, offset: float) -> Jet:
        """Add a constant."""
        return Jet(self.value + offset, self.rate, self.rate2)

    def sine(self) -> Jet:
        """Take the sine."""
        sine, cosine = np.sin(self.value), np.cos(self.value)
        return Jet(sine, cosine * self.rate, cosine * self.rate2 - sine * self.rate**2)


@dataclass(frozen=True)
class Leg:
    """A run from rest to rest: it starts at start_s and brakes from brake_s; each ramp takes ramp_s."""

    start_s: float
    ramp_s: float
    brake_s: float
    speed_mps: float

    @property
    def end_s(self) -> float:
        """Return the time at which the crane stops, s."""
        return self.brake_s + self.ramp_s


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """The body at N instants. All (N, ...) in `yard` unless stated otherwise.

    position_m, velocity_mps, acceleration_mps2: (N, 3). yard_from_body: (N, 3, 3). body_rate_radps: (N, 3) in
    `body`.
    """

    position_m: Float64
    velocity_mps: Float64
    acceleration_mps2: Float64
    yard_from_body: Float64
    body_rate_radps: Float64


@dataclass(frozen=True, eq=False)
class SimulatedTrajectory:
    """The body's path, defined for every instant (s on the IMU's clock since the epoch).

    The crane is at rest until the start of the first leg and settles after the last. begin_x_m: low-X end of
    the path; distance_m: its length.
    """

    camera: CameraSettings
    motion: TravelSettings
    nominal_yard_from_body: Float64
    phases_rad: Float64
    begin_x_m: float
    distance_m: float
    legs: tuple[Leg, ...]
    settled_s: float
    duration_s: float
    girder: GirderSettings = field(default_factory=GirderSettings)

    @classmethod
    def plan(
        cls, length_m: float, camera: CameraSettings, motion: TravelSettings,
        nominal_yard_from_body: Float64, rng: np.random.Generator, again: np.random.Generator | None = None,
        girder: GirderSettings = GirderSettings(),  # noqa: B008
    ) -> SimulatedTrajectory:  # fmt: skip
        """Plan the travel from `overrun_m` before the stack to the same distance beyond it.

        again: stream for what is drawn anew in a further pass over the yard: everything but the rails.
        """
        distance = length_m + 2 * motion.overrun_m
        phases = rng.uniform(0, 2 * np.pi, 16)
        if again is not None:
            rng = again
            phases[:RAILS] = rng.uniform(0, 2 * np.pi, RAILS)
        shares = [0.0, *np.sort(rng.uniform(0.15, 0.85, motion.stops)).tolist(), 1.0]
        legs, start = [], motion.begin_s + motion.standstill_s
        for begin, end in pairwise(shares):
            legs.append(_leg(start, (end - begin) * distance, motion))
            start = legs[-1].end_s + motion.stop_s
        settled = legs[-1].end_s + 1.0
        return cls(
            camera, motion, nominal_yard_from_body, phases, -motion.overrun_m, distance, tuple(legs),
            settled, settled + motion.standstill_s, girder,
        )  # fmt: skip

    @property
    def start_s(self) -> float:
        """Return the time at which the crane begins to travel, s."""
        return self.legs[0].start_s

    def at(self, time_s: Float64) -> BodyMotion:
        """Evaluate the exact motion at (N,) instants."""
        t = np.asarray(time_s, dtype=np.float64)
        wheels = self._wheels(t)
        bent, (tilt_x, tilt_y) = self._bent(wheels)
        x, y, z = (
            wheel + off + bend for wheel, off, bend in zip(wheels, self._springs(t), bent, strict=True)
        )
        roll, pitch, yaw = self._turn(t)
        roll, pitch = roll + tilt_x, pitch + tilt_y
        turn = _about_z(yaw.value) @ _about_y(pitch.value) @ _about_x(roll.value)
        e_x, e_y, e_z = np.eye(3)
        yawed = _about_z(yaw.value)
        rate = (
            yaw.rate[:, None] * e_z
            + pitch.rate[:, None] * (yawed @ e_y)
            + roll.rate[:, None] * (yawed @ _about_y(pitch.value) @ e_x)
        )
        yard_from_body = turn @ self.nominal_yard_from_body
        return BodyMotion(
            np.stack([x.value, y.value, z.value], axis=1),
            np.stack([x.rate, y.rate, z.rate], axis=1),
            np.stack([x.rate2, y.rate2, z.rate2], axis=1),
            yard_from_body,
            np.einsum("nij,ni->nj", yard_from_body, rate),
        )

    def wheels_m(self, time_s: Float64) -> Float64:
        """Evaluate the body's position (N, 3) by wheels and drum, without springs and rails."""
        return np.stack([jet.value for jet in self._wheels(np.asarray(time_s, np.float64))], axis=1)

    def time_at_x(self, x_m: float) -> float:
        """Find by bisection the time at which the travel, without sway, reaches `x_m`."""
        low, high = self.start_s, self.legs[-1].end_s
        for _ in range(60):
            middle = (low + high) / 2
            reached = self.begin_x_m + self._way(np.array([middle])).value[0]
            is_before = reached > x_m if self.motion.backward else reached < x_m
            low, high = (middle, high) if is_before else (low, middle)
        return (low + high) / 2

    def _travel(self, t: Float64) -> Jet:
        total: Jet | None = None
        for leg in self.legs:
            up, down = _ramp(t, leg.start_s, leg.ramp_s), _ramp(t, leg.brake_s, leg.ramp_s)
            one = up.scaled(leg.speed_mps) + down.scaled(-leg.speed_mps)
            total = one if total is None else total + one
        assert total is not None
        return total

    def _way(self, t: Float64) -> Jet:
        """Compute the distance from the path's end at low X."""
        travel = self._travel(t)
        return travel.scaled(-1).shifted(self.distance_m) if self.motion.backward else travel

    def _envelope(self, t: Float64) -> Jet:
        """Fade from 0 at rest to 1 under way; the sway decays while the crane brakes and settles."""
        first, last = self.legs[0], self.legs[-1]
        fade = _smoothstep(t, last.brake_s, self.settled_s - last.brake_s)
        return _smoothstep(t, first.start_s, first.ramp_s) * fade.scaled(-1).shifted(1)

    def _wave(self, t: Float64, hertz: float, number: int) -> Jet:
        omega = 2 * np.pi * hertz
        angle = omega * t + self.phases_rad[number]
        return Jet(np.sin(angle), omega * np.cos(angle), -(omega**2) * np.sin(angle))

    def _wheels(self, t: Float64) -> tuple[Jet, Jet, Jet]:
        """Compute travel, sway and vibration along x, y and z."""
        envelope, sway, shake = self._envelope(t), self.motion.sway_hz, self.motion.vibration_hz
        swing_m = 1.2 * np.radians(self.motion.sway_deg)
        vibration = self.motion.vibration_m
        x = self._wave(t, sway, 0).scaled(swing_m) + self._wave(t, shake, 1).scaled(vibration)
        y = self._wave(t, 0.21 * sway, 2).scaled(2 * swing_m) + self._wave(t, 1.13 * shake, 3).scaled(
            vibration
        )
        z = self._wave(t, 0.8 * sway, 4).scaled(0.6 * swing_m) + self._wave(t, 1.31 * shake, 5).scaled(
            vibration
        )
        trolley = _smoothstep(t, self.start_s, self.legs[-1].end_s - self.start_s)
        trolley = trolley.scaled(self.motion.trolley_m).shifted(-self.motion.trolley_m / 2)
        return (
            self._way(t).shifted(self.begin_x_m) + envelope * x,
            (envelope * y + trolley).shifted(self.camera.trolley_y_m),
            (envelope * z).shifted(self.camera.above_floor_m),
        )

    def _springs(self, t: Float64) -> tuple[Jet, Jet, Jet]:
        """Compute the movement along x, y and z that no encoder sees: springs and rails."""
        envelope, motion = self._envelope(t), self.motion
        waves = [
            self._wave(t, hertz, 11 + k).scaled(amplitude)
            for k, (hertz, amplitude) in enumerate(
                zip(motion.oscillation_hz, motion.oscillation_m, strict=True)
            )
        ]
        up, aside = (
            self._along(t, wave, RAILS + k).scaled(motion.rail_m) for k, wave in enumerate(RAIL_WAVE_M)
        )
        return envelope * waves[0], envelope * waves[1] + aside, envelope * waves[2] + up

    def _bent(self, wheels: tuple[Jet, Jet, Jet]) -> tuple[tuple[Jet, Jet, Jet], tuple[Jet, Jet]]:
        """Bend girder and rails under the crane point: the displacement along x, y and z, and the tilt
        about x and y with the local slope.
        """
        girder, lever = self.girder, CRANE_TO_BODY_M
        x, y = wheels[0].shifted(-lever[0]), wheels[1].shifted(-lever[1])
        sag, slope_y = _parabola(y, girder.ends_y_m)
        hollow, slope_x = _parabola(x, girder.rail_ends_x_m)
        tilt_x, tilt_y = slope_y.scaled(-girder.deflection_m), slope_x.scaled(girder.rail_m)
        aside = y.shifted(-sum(girder.ends_y_m) / 2).scaled(1e-3 * girder.skew_mm_per_m)
        down = sag.scaled(-girder.deflection_m) + hollow.scaled(-girder.rail_m)
        return (
            aside + tilt_y.scaled(lever[2]), tilt_x.scaled(-lever[2]),
            down + tilt_x.scaled(lever[1]) + tilt_y.scaled(-lever[0]),
        ), (tilt_x, tilt_y)  # fmt: skip

    def _along(self, t: Float64, wave_m: float, number: int) -> Jet:
        """Evaluate a wave over the path along X, which is the same in both directions of travel."""
        return self._way(t).scaled(2 * np.pi / wave_m).shifted(float(self.phases_rad[number])).sine()

    def _turn(self, t: Float64) -> tuple[Jet, Jet, Jet]:
        envelope, sway, shake = self._envelope(t), self.motion.sway_hz, self.motion.vibration_hz
        swing = np.radians(self.motion.sway_deg)
        tremble = 0.5 * self.motion.vibration_m
        roll = self._wave(t, 1.1 * sway, 6).scaled(swing) + self._wave(t, shake, 7).scaled(tremble)
        pitch = self._wave(t, sway, 8).scaled(0.8 * swing) + self._wave(t, 1.2 * shake, 9).scaled(tremble)
        yaw = self._wave(t, 0.37 * sway, 10).scaled(0.6 * swing)
        skew = self._along(t, SKEW_WAVE_M, 10).scaled(float(np.radians(self.motion.skew_deg)))
        return envelope * roll, envelope * pitch, envelope * yaw + skew


def _parabola(place: Jet, ends_m: tuple[float, float]) -> tuple[Jet, Jet]:
    """Evaluate the parabola that is 0 at both ends and 1 at the centre, and its slope per metre."""
    span = ends_m[1] - ends_m[0]
    share = place.shifted(-ends_m[0]).scaled(1 / span)
    rest = share.scaled(-1).shifted(1)
    return (share * rest).scaled(4), share.scaled(-2).shifted(1).scaled(4 / span)


def _leg(start_s: float, distance_m: float, motion: TravelSettings) -> Leg:
    """Plan a run from rest to rest, slower if the distance is too short for full speed."""
    acceleration = motion.acceleration_mps2
    speed = min(motion.speed_mps, float(np.sqrt(distance_m * acceleration / SMOOTHSTEP_PEAK_SLOPE)))
    ramp = SMOOTHSTEP_PEAK_SLOPE * speed / acceleration
    return Leg(start_s, ramp, start_s + distance_m / speed, speed)


def _smoothstep(t: Float64, begin_s: float, span_s: float) -> Jet:
    """Step from 0 to 1 with two continuous derivatives: 6u^5 - 15u^4 + 10u^3."""
    u = np.clip((t - begin_s) / span_s, 0, 1)
    rate = 30 * u**2 * (u - 1) ** 2 / span_s
    rate2 = 60 * u * (u - 1) * (2 * u - 1) / span_s**2
    return Jet(u**3 * (u * (6 * u - 15) + 10), rate, rate2)


def _ramp(t: Float64, begin_s: float, span_s: float) -> Jet:
    """Integrate the smooth step over time (s), with its derivatives."""
    step = _smoothstep(t, begin_s, span_s)
    u = np.clip((t - begin_s) / span_s, 0, 1)
    beyond = np.maximum(t - begin_s - span_s, 0)
    return Jet(span_s * (u**6 - 3 * u**5 + 2.5 * u**4) + beyond, step.value, step.rate)


def _about_x(angle: Float64) -> Float64:
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([one, zero, zero, zero, c, -s, zero, s, c], axis=1).reshape(-1, 3, 3)


def _about_y(angle: Float64) -> Float64:
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=1).reshape(-1, 3, 3)


def _about_z(angle: Float64) -> Float64:
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
