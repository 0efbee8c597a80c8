"""Build the map while packets still come: each view is fused once its pose is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.timing import Stopwatch
from barsight.core.types import PosedFrame, RectifiedPair, RefusedFrame
from barsight.map_building import FusedViews
from barsight.mapping.keyframes import keyframe_spacing_m
from barsight.mapping.recording_probe import choose_cell_size, points_per_pixel, probe_recording
from barsight.mapping.surface.height_selection import ViewFrusta
from barsight.mapping.surface.incremental import SurfaceElection
from barsight.mapping.surface.surface import Surface
from barsight.mapping.tiles import TileStore
from barsight.mapping.view import MatchedFrame, PointBinner
from barsight.measure_settings import MeasureSettings
from barsight.measurement import Refusal
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.yard.sections import surface_map
from barsight.yard.types import HeightMap
from barsight.yard_frame import frame_of


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The map as it stands. surface: None while nothing is seen by two views, or nothing says where.

    frames: in the map. owner: the session, in whose folder the surface lies.
    """

    surface: Surface | None
    frames: int
    owner: object = field(default=None, repr=False)

    @cached_property
    def height_map(self) -> HeightMap | None:
        """Return the whole map."""
        if self.surface is None:
            return None
        rows, columns = self.surface.shape
        return surface_map(self.surface).part(slice(0, rows), slice(0, columns))


class LiveMap:
    """Fuses posed pairs; `folder` takes its tiles and surfaces.

    Raises InputError or MeasurementError where none of the pairs so far can be matched.
    """

    def __init__(
        self, pairs: RectifiedPairs, settings: MeasureSettings, folder: Path,
        match: Callable[[RectifiedPair | RefusedFrame], MatchedFrame | Refusal],
    ) -> None:  # fmt: skip
        first, self._rectifier, self._match = probe_recording(pairs), pairs.rectifier, match
        has_crane = pairs.recording.crane() is not None
        cell_m = settings.map.cell_m or choose_cell_size(first, has_crane=has_crane)
        self._settings, self._per_pixel = settings.map, points_per_pixel(first, cell_m)
        binner = PointBinner(
            settings.stereo, self._rectifier.body_from_rect0, cell_m, self._per_pixel,
            settings.map.max_sigma_m, Stopwatch(),
        )  # fmt: skip
        store = TileStore(folder, settings.map.resident_tiles)
        self._views = FusedViews(binner, store, settings.map, frame_of(pairs.recording))
        self._election = SurfaceElection(store, folder, cell_m, settings.map)
        self._min_way_m = keyframe_spacing_m(self._rectifier.camera, first.range_m, settings.map.min_shift)
        self._ahead = np.array([0.0, 0.0, first.range_m])
        self._last: Float64 | None = None

    def add(self, pair: RectifiedPair, posed: PosedFrame) -> None:
        """Match a pair and fuse it, unless its picture has hardly moved."""
        seen = (posed.reference_from_body @ self._rectifier.body_from_rect0).apply(self._ahead)
        if self._last is not None and np.linalg.norm(seen - self._last) < self._min_way_m:
            return
        if not isinstance(self._views.add(self._match(pair), posed), Refusal):
            self._last = seen
            self._election.settle(self._settings.min_views, self._frusta)

    def snapshot(self, owner: object) -> Snapshot:
        """Elect the surface as it stands; only tiles that changed since the last one are elected anew."""
        placed = self._views.placed
        if len(placed) < 2:
            return Snapshot(None, len(placed))
        surface = self._election.snapshot(self._settings.min_views, self._frusta())
        return Snapshot(surface, len(placed), owner)

    def _frusta(self) -> ViewFrusta:
        return ViewFrusta.of(self._views.placed, self._rectifier.camera, self._per_pixel)
