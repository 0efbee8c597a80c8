"""Write trajectories, contours and the laser's profiles as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from barsight.core.files import atomic_path
from barsight.core.records.heights import Contour
from barsight.core.records.sensor_samples import LaserProfile
from barsight.core.records.trajectory import Trajectory
from barsight.core.stamps import format_seconds


def write_trajectory(trajectory: Trajectory, target: Path, frame_id: str) -> None:
    """Write TUM: seconds with nine decimals, x y z qx qy qz qw of `yard_from_body` (or `world_from_body`). A
    comment names the frame.
    """
    with atomic_path(target) as path, path.open("w", encoding="ascii") as file:
        file.write(f"# {trajectory.reference}_from_body: timestamp_s x y z qx qy qz qw\n")
        file.write(f"# frame {frame_id}\n")
        for frame in trajectory.frames:
            pose = frame.reference_from_body
            numbers = (*pose.translation, *pose.quaternion_xyzw)
            file.write(f"{format_seconds(frame.stamp_ns)} {' '.join(f'{n:.9f}' for n in numbers)}\n")


def write_relative(trajectory: Trajectory, target: Path) -> None:
    """Write CSV with a row for each frame but the first: its pose in the body axes of the previous frame, x y
    z (m) and quaternion, and the upper triangle of its covariance row by row (rotation in rad, then
    translation in m, of a small motion that follows it); nan if unknown.
    """
    detail = trajectory.detail
    if detail is None or detail.relative is None:
        return
    upper = np.triu_indices(6)
    names = ",".join(f"c{i}{j}" for i, j in zip(*upper, strict=True))
    with atomic_path(target) as path, path.open("w", encoding="ascii") as file:
        file.write(f"#from [ns],to [ns],x [m],y [m],z [m],qx,qy,qz,qw,{names}\n")
        pairs = zip(trajectory.frames, trajectory.frames[1:], detail.relative.covariance, strict=False)
        for old, new, covariance in pairs:
            moved = old.reference_from_body.inverse() @ new.reference_from_body
            pose = ",".join(f"{n:.9f}" for n in (*moved.translation, *moved.quaternion_xyzw))
            spread = ",".join(f"{n:.6e}" for n in covariance[upper])
            file.write(f"{old.stamp_ns},{new.stamp_ns},{pose},{spread}\n")


def write_contours(contours: tuple[Contour, ...], target: Path) -> None:
    """Write `profile,x_m,y_m,z_m,sigma_m,source`; z and sigma are empty if unknown."""
    with atomic_path(target) as path, path.open("w", encoding="ascii") as file:
        file.write("profile,x_m,y_m,z_m,sigma_m,source\n")
        for contour in contours:
            for x, y, z, sigma, source in zip(
                contour.x_m, contour.y_m, contour.z_m, contour.sigma_m, contour.source, strict=True
            ):
                height = f"{z:.5f},{sigma:.5f}" if np.isfinite(z) else ","
                file.write(f"{contour.profile},{x:.4f},{y:.4f},{height},{source}\n")


def write_laser_csv(laser: tuple[LaserProfile, ...], target: Path) -> None:
    """Write the reference profiles as read: `profile,x_m,y_m,z_m,sigma_m`."""
    with atomic_path(target) as path, path.open("w", encoding="ascii") as file:
        file.write("profile,x_m,y_m,z_m,sigma_m\n")
        for profile in laser:
            sigma = f"{profile.range_std_m:.5f}" if np.isfinite(profile.range_std_m) else ""
            for x, y, z in zip(profile.x_m, profile.y_m, profile.z_m, strict=True):
                file.write(f"{profile.profile},{x:.4f},{y:.4f},{z:.5f},{sigma}\n")
