"""Build the map: located, matched pairs -> votes in the map's cells -> height surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path

import numpy as np

from barsight.core.errors import Failed, MeasurementError
from barsight.core.json_values import json_digest, json_value
from barsight.core.memory import trim_heap
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera, RefusedFrame
from barsight.core.records.trajectory import PosedFrame
from barsight.core.timing import ProgressCallback, unwatched
from barsight.mapping.election.surface_election import SurfaceElection
from barsight.mapping.free_space import FreeSpace
from barsight.mapping.fusion import fuse_view
from barsight.mapping.settings import MapSettings
from barsight.mapping.spilled_tiles import SpilledTiles
from barsight.mapping.surface.height_selection import ViewFrusta
from barsight.mapping.surface.surface import Surface
from barsight.mapping.tiles import TileStore
from barsight.mapping.top_photo import TopPhoto
from barsight.mapping.view import MatchedFrame, Neighbour, PointBinner, PosedView
from barsight.measure_settings import MeasureSettings
from barsight.measurement import BuiltMap, Preview, Refusal
from barsight.reconstruction.checkpoint import checkpointed
from barsight.reconstruction.probed_recording import ProbedRecording
from barsight.reconstruction.tracked_recording import TrackedRecording
from barsight.registration.yard_file import YardFrame
from barsight.yard_frame import frame_of, shared_height_sigma_m

_TIDIED_EVERY = 8
"""Number of frames after which freed memory is returned to the system."""
_FREE_TILES = 64
"""Number of tiles of free space in memory: those under a view from 20 m."""


class MapBuilder:
    """Fuses posed frames, one after the other, into tiles in `folder`, and carves free space along their
    lines of sight.

    placed: reference_from_rect0 of the views used; stamps_ns: their stamps. beat: called for each finished
    tile.
    """

    def __init__(
        self, binner: PointBinner, camera: RectifiedCamera, folder: Path, settings: MapSettings,
        yard: YardFrame | None = None, beat: Callable[[], None] = unwatched,
    ) -> None:  # fmt: skip
        self._binner, self._camera, self._settings, self._yard = binner, camera, settings, yard
        self._store = TileStore(folder, settings.resident_tiles)
        self._election = SurfaceElection(self._store, folder, binner.cell_m, settings, beat)
        self._free = FreeSpace(binner.cell_m, SpilledTiles(folder, _FREE_TILES))
        self._tops = TopPhoto(binner.cell_m, SpilledTiles(folder))
        self._before: Neighbour | None = None
        self._previews: list[tuple[int, Preview]] = []
        self.placed: list[Pose] = []
        self.stamps_ns: list[int] = []
        self.refusals: list[Refusal] = []

    def add(self, frame: MatchedFrame | Refusal, posed: PosedFrame, after: Neighbour | None) -> None:
        """Bin a frame's points and fuse them. after: the next frame; compared with it and with the one
        before, the crane's own parts stay in place.
        """
        beside = [other for other in (self._before, after) if other is not None]
        self._before = None if isinstance(frame, Refusal) else (frame.pair, posed)
        view = frame if isinstance(frame, Refusal) else self._binner(frame, posed, beside)
        if isinstance(view, Failed):
            view = Refusal("stereo", RefusedFrame(posed.stamp_ns, view.reason))
        if isinstance(view, Refusal):
            self.refusals.append(view)
            return
        view, watch = self._with_shared(view, posed), self._binner.watch
        with watch("fuse", 1):
            fuse_view(self._store, view.cells, self._settings)
        self.placed.append(posed.reference_from_body @ self._binner.body_from_rect0)
        self.stamps_ns.append(posed.stamp_ns)
        with watch("free space", 1):
            self._free.carve(view.cells, ViewFrusta.of(self.placed[-1:], self._camera).eyes[0])
        with watch("top photo", 1):
            self._tops.add(view.cells, view.pair, self.placed[-1])
        count = len(self.placed)
        if count & (count - 1) == 0:
            self._previews = [*self._previews[-1:], (count, Preview(view.pair.left, view.disparity_px))]

    def settle(self) -> None:
        """Elect the tiles that the views have left. Called after each view, it leaves less work for the
        end.
        """
        self._election.settle(self._min_views, self._frusta)

    def snapshot(self) -> Surface:
        """Elect the current surface; only tiles that changed since the last snapshot are elected again."""
        return self._election.snapshot(self._min_views, self._frusta())

    def finish(self) -> BuiltMap:
        """Elect the surface of all views, of which there must be at least one; the tiles are deleted."""
        with self._binner.watch("surface"):
            surface = self._election.finish(self._min_views, self._frusta())
        trim_heap()
        middle = len(self.placed) / 2
        _, preview = min(self._previews, key=lambda one: abs(one[0] - middle))
        return BuiltMap(
            surface, self._free, self._tops, tuple(self.placed), tuple(self.stamps_ns), tuple(self.refusals),
            preview,
        )  # fmt: skip

    @property
    def _min_views(self) -> int:
        return self._settings.min_views if len(self.placed) > 1 else 1

    def _frusta(self) -> ViewFrusta:
        return ViewFrusta.of(self.placed, self._camera, self._binner.per_pixel)

    def _with_shared(self, view: PosedView, posed: PosedFrame) -> PosedView:
        """Add the yard frame's uncertainty to the error that all heights share."""
        if self._yard is None:
            return view
        cells, size = view.cells, self._binner.cell_m
        body_m = posed.reference_from_body.translation
        x_m, y_m = (np.multiply(of, size, dtype=np.float64) for of in (cells.x, cells.y))
        off = shared_height_sigma_m(self._yard, x_m, y_m, body_m)
        shared = np.hypot(cells.shared_m, off).astype(np.float32)
        return replace(view, cells=replace(cells, shared_m=shared))


def build_map(
    probed: ProbedRecording,
    way: TrackedRecording,
    settings: MeasureSettings,
    scratch: Path,
    advance: ProgressCallback,
) -> BuiltMap:
    """Build the map of all matched pairs, or load its checkpoint if it is of exactly these pairs and poses.

    Raises MeasurementError where no frame could be measured, or no place was seen by enough frames.
    """
    source, path = probed.source, probed.source.path
    refusals = [Refusal("recording", frame) for frame in source.index.unpaired]
    refusals += [Refusal("trajectory", frame) for frame in way.trajectory.refused]
    refusals += way.refusals
    binner = PointBinner(
        way.stereo, way.rectifier.body_from_rect0, probed.cell_m, probed.per_pixel, settings.map.max_sigma_m,
        probed.watch,
    )  # fmt: skip

    def build() -> BuiltMap:
        builder = MapBuilder(binner, way.rectifier.camera, scratch, settings.map, frame_of(source))
        known = (frame for frame in way.matched if frame.stamp_ns in way.poses)
        for done, (frame, after) in enumerate(pairwise(chain(known, (None,))), start=1):
            assert frame is not None
            beside = None
            if isinstance(after, MatchedFrame):
                beside = after.pair, way.poses[after.stamp_ns]
            builder.add(frame, way.poses[frame.stamp_ns], beside)
            if done % _TIDIED_EVERY == 1:
                trim_heap()
            advance("map", done, len(way.poses))
        if not builder.placed:
            reason = _first_reason([*refusals, *builder.refusals])
            raise MeasurementError(f"{path}: no frame could be measured; {reason}")
        return builder.finish()

    name = map_name(tuple(way.poses.values()), binner)
    built = checkpointed(probed.checkpoints, name, build)
    if built.surface.seen == 0:
        least = settings.map.min_views if len(built.placed) > 1 else 1
        raise nothing_seen(path, least, settings.map)
    return replace(built, refusals=(*refusals, *built.refusals))


def nothing_seen(path: Path, frames: int, settings: MapSettings) -> MeasurementError:
    """Word the refusal of a map without a seen cell, with what to change."""
    cell = (
        ""
        if settings.cell_m is None
        else f", or choose smaller cells than map.cell_m = {settings.cell_m:g} m"
    )
    return MeasurementError(f"{path}: no place was seen by {frames} frames; lower map.min_views{cell}")


def map_name(poses: tuple[PosedFrame, ...], binner: PointBinner) -> str:
    """Name the checkpoint of the map of frames at these poses after what it depends on besides
    `checkpoint_key`.
    """
    asked = [binner.stereo.calibration_sigma_px, binner.cell_m, binner.per_pixel]
    return f"map_{json_digest([json_value(poses), asked])[:32]}"


def _first_reason(refusals: list[Refusal]) -> str:
    return f"first: {refusals[0].frame.reason}" if refusals else "it has no frames"
