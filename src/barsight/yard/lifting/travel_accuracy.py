"""Estimate the map's position uncertainty along the crane's path, and check that it is small enough for a
lift there.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from scipy.interpolate import interp1d

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.errors import Failed
from barsight.core.pose import skew
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import Trajectory
from barsight.motion.crane.encoder_trajectory import fit_position
from barsight.yard.cameras import Cameras
from barsight.yard.lift_settings import UPPER, LiftSettings
from barsight.yard.magnet.description import MAX_TURN_DEG, Magnet, MagnetOffset
from barsight.yard.magnet.footprint import Placement
from barsight.yard.types import Bundle
from barsight.yard.vetoes import Check, check_max, check_true
from barsight.yard.weight import load_centre

ALONGSIDE_M = 1.0
"""Distance (m) from the lift within which encoders and map are compared where the crane passed."""
SURE_SIGMAS = 3.0
"""Number of the trajectory's sigmas beyond which encoders count as disagreeing with it."""
MOVING_MPS = 0.05
"""Minimum speed (m/s) from which a latency of the encoders shows."""
CODE = "trajectory-degraded"


@dataclass(frozen=True, eq=False)
class Travel:
    """Uncertainty of the frames' poses over the yard.

    place_m: (N, 2) x and y of the body. sigma_m: (N, 3) of the ground below it in x, y, z. off_m: (N,)
    distance between encoders and trajectory, NaN where there are no encoders, without what a constant latency
    explains. refused_m: (R, 2) where the refused frames must have been. reach_m: maximum distance from the
    body at which a frame may see. stamp_ns: (N,) of the frames, rising; pairs that record at once may share
    one. measured: (N,) whether a frame's heights are in the map. sure_reach_m: distance from the body within
    which everything is in the picture. eye_z_m: the body's median height; pixel_rad: angle of a pixel; both
    NaN in files of an earlier version. pass_number: (N,) pass of each frame, from 1; empty where there is
    only one. cameras: None in files of an earlier version, and where those of passes differ.
    """

    place_m: Float64
    sigma_m: Float64
    off_m: Float64
    refused_m: Float64
    reach_m: float
    stamp_ns: Int64
    measured: Bool
    sure_reach_m: float
    eye_z_m: float = float("nan")
    pixel_rad: float = float("nan")
    pass_number: Int64 = field(default_factory=lambda: np.zeros(0, np.int64))
    cameras: Cameras | None = None

    @property
    def captured_ns(self) -> tuple[int, int] | None:
        """Return the stamps of the first and the last measured frame; None without any."""
        stamps = self.stamp_ns[self.measured]
        return (int(stamps[0]), int(stamps[-1])) if stamps.size else None

    @property
    def passes(self) -> Int64:
        """Return the pass (N,) of each frame, from 1."""
        return self.pass_number if len(self.pass_number) else np.ones(len(self.place_m), np.int64)

    def pixel_m(self, z_m: float) -> float:
        """Return the size (m) of a pixel on a surface at height z_m; NaN where it isn't known."""
        return (self.eye_z_m - z_m) * self.pixel_rad

    @classmethod
    def of(
        cls, trajectory: Trajectory, crane: CraneSamples | None, shift_ns: int, window_ns: int,
        range_m: float, camera: RectifiedCamera, measured_ns: Collection[int],
    ) -> Travel:  # fmt: skip
        """Build from a trajectory. shift_ns: from the camera's clock to the encoders'. window_ns: window of
        readings that are fitted to one position. range_m: depth of the surface below the body. measured_ns:
        stamps of the frames in the map.
        """
        stamps, places = trajectory.stamp_ns, trajectory.positions_m
        lever = np.array([0.0, 0.0, -range_m])
        carry = np.hstack([-skew(lever), np.eye(3)])
        ground = [np.diag(carry @ frame.covariance @ carry.T) for frame in trajectory.frames]
        refused = np.array([frame.stamp_ns for frame in trajectory.refused], np.int64)
        return cls(
            places[:, :2],
            np.sqrt(np.maximum(np.array(ground).reshape(-1, 3), 0)),
            _disagreement(stamps, places, crane, shift_ns, window_ns),
            _places_at(refused, stamps, places),
            range_m * float(np.hypot(camera.width, camera.height)) / 2 / camera.focal_px,
            stamps,
            np.isin(stamps, list(measured_ns)),
            range_m * min(camera.width, camera.height) / 2 / camera.focal_px,
            float(np.median(places[:, 2])),
            1 / camera.focal_px,
        )  # fmt: skip

    @classmethod
    def joined(cls, parts: Sequence[Travel]) -> Travel:
        """Join the passes of one yard, oldest first; frames of pairs that record at once are interleaved."""
        stamps = np.concatenate([part.stamp_ns for part in parts])
        order = np.argsort(stamps, kind="stable")
        place, sigma, off, measured = (
            np.concatenate([getattr(part, name) for part in parts])[order]
            for name in ("place_m", "sigma_m", "off_m", "measured")
        )
        refused = np.concatenate([part.refused_m for part in parts])
        reach_m, sure_reach_m = max(part.reach_m for part in parts), min(part.sure_reach_m for part in parts)
        eye_z_m, pixel_rad = max(part.eye_z_m for part in parts), max(part.pixel_rad for part in parts)
        numbers = np.repeat(np.arange(1, len(parts) + 1), [len(part.stamp_ns) for part in parts])
        cameras = parts[0].cameras
        if cameras is not None and not all(cameras.is_like(part.cameras) for part in parts):
            cameras = None
        return cls(
            place, sigma, off, refused, reach_m, stamps[order], measured, sure_reach_m, eye_z_m, pixel_rad,
            numbers[order], cameras,
        )  # fmt: skip

    @classmethod
    def read(cls, summary: dict[str, Any]) -> Travel | None:
        """Read from result.json; None where values are missing or their numbers differ."""
        content: Any = summary.get("travel")
        try:
            place, sigma, off, refused = (
                np.array(content[name], dtype=np.float64)
                for name in ("place_m", "sigma_m", "off_m", "refused_m")
            )
            stamps = np.array(content["stamp_ns"], dtype=np.int64)
            place, sigma, refused = place.reshape(-1, 2), sigma.reshape(-1, 3), refused.reshape(-1, 2)
            measured = np.array(content["measured"], dtype=np.bool_)
            reach_m, sure_reach_m = float(content["reach_m"]), float(content["sure_reach_m"])
            eye_z_m, pixel_rad = (float(content.get(k, np.nan)) for k in ("eye_z_m", "pixel_rad"))
            numbers = np.array(content.get("pass_number", []), dtype=np.int64)
            cameras = Cameras.read(content.get("cameras"))
        except (KeyError, TypeError, ValueError, OverflowError):
            return None
        whole = (
            len({len(place), len(sigma), off.size, stamps.size, measured.size}) == 1
            and off.ndim == stamps.ndim == 1
            and numbers.shape == (stamps.shape if summary.get("passes") else (0,))
        )
        if not whole or not _rises(stamps, numbers):
            return None
        return cls(
            place, sigma, off, refused, reach_m, stamps, measured, sure_reach_m, eye_z_m, pixel_rad, numbers,
            cameras,
        )  # fmt: skip

    def content(self) -> dict[str, Any]:
        """Convert to the content of result.json; the writer handles NaN."""
        content = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(self).items()}
        return content | {"cameras": None if self.cameras is None else self.cameras.content()}


def _rises(stamps: Int64, numbers: Int64) -> bool:
    """Check that stamps (N,) rise, and that only frames of different passes (N,) share one."""
    steps = np.diff(stamps)
    same_pass = np.diff(numbers) == 0 if len(numbers) else True
    return not ((steps < 0) | ((steps == 0) & same_pass)).any()


def _places_at(wanted: Int64, stamps: Int64, places: Float64) -> Float64:
    """Interpolate x and y (R, 2) at other stamps, linearly between the placed frames and beyond them."""
    if stamps.size < 2:
        return np.empty((0, 2))
    way = interp1d(stamps - stamps[0], places[:, :2], axis=0, fill_value="extrapolate")
    return np.asarray(way(wanted - stamps[0]), dtype=np.float64)


def _disagreement(
    stamps: Int64, places: Float64, crane: CraneSamples | None, shift_ns: int, window_ns: int
) -> Float64:
    """Compute the distance (N,) between encoders and body, without what a constant latency explains."""
    if crane is None or stamps.size < 2:
        return np.full(stamps.size, np.nan)
    off = np.full((stamps.size, 3), np.nan)
    velocity = np.zeros((stamps.size, 3))
    for k, stamp in enumerate(stamps.tolist()):
        fit = fit_position(crane, stamp + shift_ns, window_ns)
        if not isinstance(fit, Failed):
            off[k] = fit.position_m + crane.crane_to_body_m - places[k]
            velocity[k] = fit.velocity_mps
    speed = np.linalg.norm(velocity, axis=1)
    moving = np.isfinite(off).all(axis=1) & (speed > MOVING_MPS)
    if moving.sum() >= 3:
        late = -(off[moving] * velocity[moving]).sum(axis=1) / speed[moving] ** 2
        off += velocity * float(np.median(late))
    size: Float64 = np.linalg.norm(off, axis=1)
    return size


def crane_checks(
    travel: Travel | None, place: Placement, magnet: Magnet, settings: LiftSettings
) -> list[Check]:
    """Check that the crane can set the magnet down on the place: by the travel, if it is known, and by the
    magnet's offset.
    """
    checks = [] if travel is None else travel_checks(travel, place, magnet, settings)
    return checks + _turn_checks(place, magnet)


def travel_checks(travel: Travel, place: Placement, magnet: Magnet, settings: LiftSettings) -> list[Check]:
    """Check that the map's position and height are accurate enough for this lift."""
    here = np.array([place.x_m, place.y_m])
    near = np.linalg.norm(travel.place_m - here, axis=1) < travel.reach_m
    reason = f"no frame was located within {travel.reach_m:.1f} m of the lift"
    checks = [check_true(CODE, "frames were located near the lift", bool(near.any()), reason)]
    if near.any():
        checks += _sure_enough(_near_sigma(travel, near), magnet, place.yaw_rad)
        refused = int((np.linalg.norm(travel.refused_m - here, axis=1) < travel.reach_m).sum())
        seen = refused + int(near.sum())
        reason = (
            f"{refused} of {seen} frames near the lift were refused; "
            f"the limit is {100 * settings.max_refused_ratio:.0f} %"
        )
        what = "share of refused frames near the lift"
        checks.append(check_max(CODE, what, refused / seen, settings.max_refused_ratio, "", reason))
    return [*checks, *_encoder_checks(travel, place, min(magnet.tolerance.x_m, magnet.tolerance.y_m))]


def _near_sigma(travel: Travel, near: Bool) -> Float64:
    """Compute the median sigma (3,) of the frames near a place. Of several passes the worst one counts, since
    any of them may have measured the heights there.
    """
    passes = travel.passes
    medians = [np.median(travel.sigma_m[near & (passes == one)], axis=0) for one in np.unique(passes[near])]
    return np.asarray(np.max(medians, axis=0))


def _encoder_checks(travel: Travel, place: Placement, max_m: float) -> list[Check]:
    """Check that encoders and map agree beside the lift and at the end of the path."""
    known = np.isfinite(travel.off_m)
    if not known.any():
        return []
    sigma = travel.sigma_m[:, :2].max(axis=1, initial=0)
    excess = np.where(known, travel.off_m - SURE_SIGMAS * sigma, -np.inf)
    away = travel.place_m - (place.x_m, place.y_m)
    far = np.hypot(away[:, 0], away[:, 1])
    # Whatever its path, the crane is beside the lift where it is nearest, and within ALONGSIDE_M of that.
    beside = far < np.hypot(far[known].min(), ALONGSIDE_M)
    passing = known & (beside | (np.abs(away[:, 0]) < ALONGSIDE_M))
    last = int(np.flatnonzero(known)[-1])
    checks = []
    if passing.any():
        worst = int(np.argmax(np.where(passing, excess, -np.inf)))
        checks.append((worst, "beside the lift", "encoders and map disagree by "
                       f"{1e3 * travel.off_m[worst]:.0f} mm within {ALONGSIDE_M:g} m of the lift; "
                       f"the limit is {1e3 * max_m:.0f} mm"))  # fmt: skip
    checks.append((last, "at the end of the travel", f"encoders and map disagree by "
                   f"{1e3 * travel.off_m[last]:.0f} mm at the end of the travel, so the crane would miss its "
                   f"target; the limit is {1e3 * max_m:.0f} mm"))  # fmt: skip
    return [
        check_max(CODE, f"lower bound of the disagreement of encoders and map {where}",
                   1e3 * float(excess[frame]), 1e3 * max_m, "mm", reason)
        for frame, where, reason in checks
    ]  # fmt: skip


def _turn_checks(place: Placement, magnet: Magnet) -> list[Check]:
    """Check that the magnet's offset, if one is stated, is known at this lift's yaw."""
    offset = magnet.offset
    if offset is None:
        return []
    turn_deg = offset.turn_deg(place.yaw_rad)
    reason = (
        f"the magnet's offset was found at yaw {offset.yaw_deg:.1f} deg and turns with the magnet; this lift "
        f"is {turn_deg:.1f} deg from it, the limit is {MAX_TURN_DEG:g} deg: touch down at this yaw too"
    )
    what = "angle to the yaw at which the magnet's offset was found"
    return [check_max("magnet-turned", what, turn_deg, MAX_TURN_DEG, "deg", reason)]


def _sure_enough(sigma: Float64, magnet: Magnet, yaw_rad: float) -> list[Check]:
    """Check that the 95 % bounds of the map's position and height are within the crane's tolerance and the
    gap, each combined with the error of the magnet's offset where that is known.
    """
    source = "trajectory"
    if magnet.offset is not None:
        sigma, source = np.hypot(sigma, magnet.offset.sigma_m(yaw_rad)), "trajectory and touch-downs"
    return [
        check_max(
            CODE, f"uncertainty of {name} near the lift (95 %), by {source}", 1e3 * UPPER * float(one),
            1e3 * most, "mm", f"{name} near the lift is uncertain by {1e3 * UPPER * one:.0f} mm (95 %, "
            f"{source}); the limit is {1e3 * most:.0f} mm",
        )
        for name, one, most in (
            ("x", sigma[0], magnet.tolerance.x_m),
            ("y", sigma[1], magnet.tolerance.y_m),
            ("height", sigma[2], magnet.limits.gap_m),
        )
    ]  # fmt: skip


def target_covariance(
    place: Placement, load: tuple[Bundle, ...], plane_sigma_m: float, map_sigma_m: float,
    travel: Travel | None, offset: MagnetOffset | None = None,
) -> Float64:  # fmt: skip
    """Estimate the covariance (4, 4) of a target's x, y, z (m) and yaw (rad), in the map's frame.

    It adds up the covariances of the bundles, of the plane over its points, of the trajectory near it, of the
    magnet's offset, and of the map. Only the map's includes the calibration's part of the heights, which
    moves the whole map; all of it is taken as shared. Of several bundles the worst counts, since their errors
    are common. NaN where a bundle's sigma isn't known.
    """
    if not load:
        return np.full((4, 4), np.nan)
    lateral, along, yaw, top = (
        max((getattr(b.sigma, name) for b in load), key=lambda s: np.inf if np.isnan(s) else s)
        for name in ("lateral_m", "along_m", "yaw_rad", "top_z_m")
    )
    axes = np.stack([place.across, place.along], axis=1)
    found = np.zeros((4, 4))
    found[:2, :2] = axes @ np.diag([lateral**2, along**2]) @ axes.T
    found[2, 2] = top**2 + plane_sigma_m**2 + map_sigma_m**2
    # An error of the load's yaw rotates the place about the load's centre of mass.
    away = np.array([place.x_m, place.y_m]) - load_centre(load)
    turn = np.array([-away[1], away[0], 0.0, 1.0])
    found += yaw**2 * np.outer(turn, turn)
    if travel is not None:
        near = np.linalg.norm(travel.place_m - (place.x_m, place.y_m), axis=1) < travel.reach_m
        shared = _near_sigma(travel, near) if near.any() else np.full(3, np.nan)
        found[:3, :3] += np.diag(shared**2)
    if offset is not None:
        found[:3, :3] += np.diag(np.square(offset.sigma_m(place.yaw_rad)))
    return found
