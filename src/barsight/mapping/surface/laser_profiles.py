"""Cut contours, hold them against the laser's profiles and fuse those into the map where it is asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barsight.core.errors import Failed
from barsight.core.notices import Notice
from barsight.core.stamps import NS_PER_S
from barsight.core.types import Agreement, Contour, LaserProfile, Trajectory
from barsight.mapping.agreement import compute_agreement
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface.contours import cut_contours
from barsight.mapping.surface.laser_check import LaserCheck, check_laser
from barsight.mapping.surface.laser_fusion import fuse_laser
from barsight.mapping.surface.surface import Surface
from barsight.recording.base import Recording


@dataclass(frozen=True, eq=False)
class Profiles:
    """The surface, with the laser where it was fused, and its contours. laser: its profiles in the map's
    frame. agreed: of vision alone with each, or why there is none. checks: of each before it was fused; None
    where that wasn't asked for. left_out: the laser is of another frame.
    """

    surface: Surface
    contours: tuple[Contour, ...]
    laser: tuple[LaserProfile, ...]
    agreed: tuple[Agreement | Failed, ...]
    checks: tuple[LaserCheck, ...] | None
    left_out: bool

    @property
    def agreements(self) -> tuple[Agreement, ...]:
        """Select the profiles that could be compared."""
        return tuple(one for one in self.agreed if isinstance(one, Agreement))

    @property
    def sensors(self) -> tuple[str, ...]:
        """Name the laser where a profile of it was fused."""
        return ("laser",) if any(check.is_believed for check in self.checks or ()) else ()

    def notices(self) -> Iterator[Notice]:
        """Yield warnings: profiles that have no agreement, or aren't believed."""
        yield from (Notice(a.code, a.reason) for a in self.agreed if isinstance(a, Failed))
        if self.left_out:
            reason = "without a crane the map isn't in the laser's yard: no agreement"
            yield Notice("laser-frame", reason)
        for check in self.checks or ():
            if not check.is_believed:
                yield Notice("laser-off", f"profile {check.profile} is not fused: {check.reason}")


def cut_profiles(
    source: Recording, trajectory: Trajectory, surface: Surface, settings: MapSettings, folder: Path
) -> Profiles:
    """Cut contours and hold them against the laser's profiles, then fuse those if the settings say so.

    Profiles are places in the yard: a map in a frame of its own can't be held against them. Agreement is that
    of vision alone: a fused map would be compared with itself. folder: takes the fused surface.
    """
    whole = source.laser()
    laser = whole if trajectory.reference == "yard" else ()

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
    return Profiles(surface, contours, laser, agreed, checks, len(laser) < len(whole))


def _speed_along_x(trajectory: Trajectory) -> float:
    """Estimate the velocity along X while travelling, signed, m/s: the median over the steps
    between frames.
    """
    seconds = np.diff(trajectory.stamp_ns) / NS_PER_S
    if seconds.size == 0:
        return float("nan")
    return float(np.median(np.diff(trajectory.positions_m[:, 0]) / seconds))
