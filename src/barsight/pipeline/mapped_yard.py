"""Measure the surface, from recordings to a mapped yard."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from barsight.core.errors import InputError
from barsight.core.parallel import single_opencv_thread
from barsight.core.records.trajectory import Trajectory
from barsight.core.timing import ProgressCallback, Stopwatch
from barsight.labels.bundle_labels import expect_readers
from barsight.mapping.free_space import FreeSpace
from barsight.mapping.passes.changes import PlaceHistory
from barsight.mapping.surface.laser_profiles import Profiles, cut_profiles
from barsight.mapping.surface.surface import Surface
from barsight.mapping.top_photo import TopPhoto
from barsight.measure_settings import MeasureSettings
from barsight.reconstruction.joined_passes import JoinedPasses, MappedPass, in_order, join_passes
from barsight.reconstruction.map_building import build_map
from barsight.reconstruction.probed_recording import inspect_recording
from barsight.reconstruction.tracked_recording import estimate_trajectory
from barsight.recording.base import Recording
from barsight.yard.inventory.stock_list import ListedBundle, read_stock
from barsight.yard_frame import frame_name


@dataclass(frozen=True, eq=False)
class MappedYard:
    """Results of the first half: trajectories, map and contours. passes: the oldest first. joined: how
    several passes became one map. trajectory: of all passes. watch: times what is done for all of them.
    began_s: clock at the start.
    """

    settings: MeasureSettings
    passes: tuple[MappedPass, ...]
    joined: JoinedPasses | None
    trajectory: Trajectory
    surface: Surface
    free: FreeSpace
    tops: TopPhoto
    profiles: Profiles
    stock: tuple[ListedBundle, ...] | None
    watch: Stopwatch
    began_s: float

    @property
    def newest(self) -> MappedPass:
        """Return the pass that was recorded last."""
        return self.passes[-1]

    @property
    def frame_id(self) -> str:
        """Return the name of the frame of all positions."""
        return frame_name(self.newest.probed.source, self.trajectory, self.newest.probed.inputs)

    @property
    def history(self) -> PlaceHistory | None:
        """Return which pass saw each place last, and what changed; None for a single pass."""
        return None if self.joined is None else self.joined.history


@single_opencv_thread()
def map_yard(
    recordings: Sequence[Recording], settings: MeasureSettings, scratch: Path, advance: ProgressCallback,
    resume: Path | None = None,
) -> MappedYard:  # fmt: skip
    """Measure the surface. `scratch` is an empty folder for tiles and pictures, which the caller removes.

    recordings: passes over one yard, in any order; each is measured by itself, one after the other, then they
    are tied and joined. resume: a folder that stores the trajectory and each frame's disparity (about 19 MB
    for 1.3 megapixels), so that a killed run can resume; the caller removes it once everything is written.

    Raises InputError or MeasurementError where nothing can be measured, ConfigError where labels are to be
    read but their readers aren't installed; single frames that fail are refused and listed instead.
    """
    began_s, settings = time.perf_counter(), settings.chosen()
    stock = read_stock(settings.bundles.stock_list) if settings.bundles.stock_list else None
    expect_readers(settings.labels)
    ordered = in_order(recordings, settings)
    several = len(ordered) > 1
    passes, surfaces = [], []
    for number, recording in enumerate(ordered, start=1):
        own, kept = scratch, resume
        if several:
            own = scratch / f"pass_{number}"
            own.mkdir()
            kept = None if resume is None else resume / own.name
        probed = inspect_recording(recording, settings, own, kept)
        with estimate_trajectory(probed, settings, advance) as way:
            built = build_map(probed, way, settings, own, advance)
        surfaces.append(built.surface)
        passes.append(MappedPass(probed, way, built))
        if several:
            _expect_same_cells(passes)
            _remove_pictures(own)
    joined, watch = None, passes[0].probed.watch
    if several:
        watch = Stopwatch()
        with watch("join"):
            folder = scratch / "joined"
            folder.mkdir()
            joined = join_passes(passes, surfaces, folder, settings.lift.max_age_s)
    done = joined.passes if joined else tuple(passes)
    surface = joined.surface if joined else surfaces[0]
    free, tops = (joined.free, joined.tops) if joined else (passes[0].built.free, passes[0].built.tops)
    trajectory = _whole([one.way.trajectory for one in done])
    with watch("contours"):
        profiles = cut_profiles(done[-1].probed.source, trajectory, surface, settings.map, scratch)
    surface = profiles.surface
    return MappedYard(
        settings, done, joined, trajectory, surface, free, tops, profiles, stock, watch, began_s
    )


def _expect_same_cells(passes: Sequence[MappedPass]) -> None:
    first, last = (one.probed for one in (passes[0], passes[-1]))
    if last.cell_m != first.cell_m:
        problem = f"its map has cells of {last.cell_m:g} m, those before of {first.cell_m:g} m"
        raise InputError(last.source.path, problem, "set map.cell_m")


def _remove_pictures(folder: Path) -> None:
    """Delete a finished pass's rectified pictures to make room for those of the next one."""
    for path in folder.glob("rectified_*.npy"):
        path.unlink()


def _whole(trajectories: Sequence[Trajectory]) -> Trajectory:
    """Chain the trajectories of passes, the oldest first, without what only single ones have. If two pairs
    on one body have a frame of the same stamp, the first pair's counts.
    """
    if len(trajectories) == 1:
        return trajectories[0]
    frames = {frame.stamp_ns: frame for one in reversed(trajectories) for frame in one.frames}
    return Trajectory(
        trajectories[0].reference,
        tuple(frames[stamp_ns] for stamp_ns in sorted(frames)),
        tuple(frame for one in trajectories for frame in one.refused),
        tuple(dict.fromkeys(name for one in trajectories for name in one.sensors)),
    )
