"""Cut contours, compare them with the laser's profiles and, if the settings say so, fuse those into the
map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barsight.core.errors import Failed
from barsight.core.notices import Notice
from barsight.core.records.heights import Agreement, Contour
from barsight.core.records.sensor_samples import LaserProfile
from barsight.core.records.trajectory import Trajectory
from barsight.core.stamps import NS_PER_S
from barsight.mapping.agreement import compute_agreement
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface.contours import cut_contours
from barsight.mapping.surface.laser_check import LaserCheck, check_laser
from barsight.mapping.surface.laser_fusion import fuse_laser
from barsight.mapping.surface.surface import Surface
from barsight.recording.base import Recording

MAX_ASKEW_M = 0.03
"""Maximum extent of a profile across X for it to count as running along X: three cells of 10 mm."""


@dataclass(frozen=True, eq=False)
class Profiles:
    """The surface, with the laser where it was fused, and its contours. laser: its profiles in the map's
    frame. agreed: agreement of vision alone with each profile, or why there is none. checks: of each
    profile before fusion; None if fusion wasn't requested. left_out: True if the laser is in another
    frame. askew: numbers of the profiles that don't run along X.
    """

    surface: Surface
    contours: tuple[Contour, ...]
    laser: tuple[LaserProfile, ...]
    agreed: tuple[Agreement | Failed, ...]
    checks: tuple[LaserCheck, ...] | None
    left_out: bool
    askew: tuple[int, ...] = ()

    @property
    def agreements(self) -> tuple[Agreement, ...]:
        """Select the agreements of profiles that could be compared."""
        return tuple(one for one in self.agreed if isinstance(one, Agreement))

    @property
    def sensors(self) -> tuple[str, ...]:
        """List the laser if any of its profiles was fused."""
        return ("laser",) if any(check.is_believed for check in self.checks or ()) else ()

    def notices(self) -> Iterator[Notice]:
        """Yield warnings about profiles that have no agreement or are rejected."""
        yield from (Notice(a.code, a.reason) for a in self.agreed if isinstance(a, Failed))
        if self.left_out:
            reason = "without a crane the map isn't in the laser's yard: no agreement"
            yield Notice("laser-frame", reason)
        if self.askew:
            reason = f"profiles {', '.join(map(str, self.askew))} don't run along X: no agreement"
            yield Notice("laser-askew", reason)
        first, last = (row * self.surface.cell_m for row in self.surface.rows)
        beside = {profile.profile for profile in self.laser}
        for y in (float(one.y_m[0]) for one in self.contours if one.y_m.size and one.profile not in beside):
            if not first <= y <= last:
                extent = f"the map reaches from {first:.2f} to {last:.2f} m"
                yield Notice("profile-outside", f"contour at y {y:g} m: empty, {extent}")
        for check in self.checks or ():
            if not check.is_believed:
                yield Notice("laser-off", f"profile {check.profile} is not fused: {check.reason}")


def cut_profiles(
    source: Recording, trajectory: Trajectory, surface: Surface, settings: MapSettings, folder: Path
) -> Profiles:
    """Cut contours, compare them with the laser's profiles, then fuse those if the settings say so.

    Profiles have positions in the yard: a map in its own frame can't be compared with them. Agreement is that
    of vision alone, since a fused map would be compared with itself. folder: receives the fused surface.
    """
    whole = source.laser()
    in_frame = whole if trajectory.reference == "yard" else ()
    laser = tuple(profile for profile in in_frame if runs_along_x(profile))
    askew = tuple(profile.profile for profile in in_frame if not runs_along_x(profile))

    def cut(of: Surface) -> tuple[Contour, ...]:
        return cut_contours(of, laser, settings.profile_y_m, settings.contours)

    contours = cut(surface)
    by_number = {contour.profile: contour for contour in contours}
    speed_mps = _speed_along_x(trajectory)
    agreed = tuple(
        compute_agreement(by_number[p.profile], p, speed_mps) for p in laser if p.profile in by_number
    )
    checks = None
    if settings.laser == "fuse":
        beside = cut_contours(surface, laser, ())
        checks = (
            tuple(check_laser(*pair, settings) for pair in zip(beside, laser, strict=True)) if laser else ()
        )
        believed = [profile for profile, check in zip(laser, checks, strict=True) if check.is_believed]
        if believed:
            with_laser = folder / "with_laser"
            with_laser.mkdir()
            surface = fuse_laser(surface, believed, settings, with_laser)
            contours = cut(surface)
    return Profiles(surface, contours, laser, agreed, checks, len(in_frame) < len(whole), askew)


def runs_along_x(profile: LaserProfile) -> bool:
    """Check that a profile keeps its y, so that a contour at that y covers the same places."""
    return bool(np.ptp(profile.y_m) <= MAX_ASKEW_M)


def _speed_along_x(trajectory: Trajectory) -> float:
    """Estimate the travelling velocity along X, signed, m/s: the median over the steps between frames."""
    seconds = np.diff(trajectory.stamp_ns) / NS_PER_S
    if seconds.size == 0:
        return float("nan")
    return float(np.median(np.diff(trajectory.positions_m[:, 0]) / seconds))
