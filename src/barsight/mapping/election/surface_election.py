"""Elect the whole surface, tile by tile, reusing what hasn't changed since the last election."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from barsight.core.arrays import Float32, Float64, Int8
from barsight.core.parallel import ordered_map
from barsight.core.timing import unwatched
from barsight.mapping.election.first_heights import first_around, first_file, read_first
from barsight.mapping.election.tile_finishing import finished_layers
from barsight.mapping.settings import MapSettings
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.surface.cloud import CloudPart, cloud_file
from barsight.mapping.surface.height_selection import (
    ViewFrusta,
    ViewSupport,
    elect_by_votes,
    elect_surface,
    supported_box,
)
from barsight.mapping.surface.surface import Surface, elected_layers, read_tile, tile_file, write_tile
from barsight.mapping.surface.tile_figures import TileFigures, gather_surface, tile_figures
from barsight.mapping.tiles import TileStore, tiles_around

Result = TypeVar("Result")

_MIDDLE = 4
"""Index of a tile among its `tiles_around`."""


@dataclass(frozen=True, eq=False)
class TileElection:
    """Inputs that a tile's election depends on.

    versions: of the tile and its neighbours (see `TileStore`). box: corners (m) of its supported heights,
    None without any. near: number of views that may see something in the box. height_m: of their cameras.
    is_last: True for a final election, False for a snapshot's.
    """

    versions: tuple[int, ...]
    min_views: int
    is_last: bool
    box: Float64 | None
    near: int
    height_m: float


class SurfaceElection:
    """Elects the surface of the tiles in `store`; its files and those of the surfaces are stored in `folder`.

    Poses must not change once given: each `ViewFrusta` begins with the views of the one before. Nothing in
    `store` is changed except by `finish`. beat: called for each finished tile.
    """

    def __init__(
        self, store: TileStore, folder: Path, cell_m: float, settings: MapSettings,
        beat: Callable[[], None] = unwatched,
    ) -> None:  # fmt: skip
        self._beat = beat
        self._store, self._folder, self._cell_m, self._settings = store, folder, cell_m, settings
        work = Path(tempfile.mkdtemp(prefix="election_", dir=folder))
        self._first, self._elected, self._finished, asked = (
            work / name for name in ("first", "elected", "finished", "asked")
        )
        for made in (self._first, self._elected, self._finished, asked):
            made.mkdir()
        self._work = work
        self._taken: dict[TileKey, int] = {}
        self._voted: dict[TileKey, tuple[int, int]] = {}
        self._elections: dict[TileKey, TileElection] = {}
        self._finishes: dict[TileKey, tuple[TileElection | None, ...]] = {}
        self._heights = TileStore(asked, settings.resident_tiles // 2, fields=3, fill=np.nan)
        self._views: dict[TileKey, int] = {}
        self._figures: dict[TileKey, TileFigures] = {}

    def settle(self, min_views: int, frusta: Callable[[], ViewFrusta]) -> None:
        """Run the final election of the tiles that the last view touched neither directly nor in a
        neighbour, and finish those whose neighbours are elected too: a snapshot and `finish` then need to
        process only the tiles around the view. Call it after each view.
        """
        keys = self._store.keys()
        taken = {key: self._store.version(key) for key in keys}
        in_view = {key for key, count in taken.items() if self._taken.get(key) != count}
        self._taken = taken
        left = [key for key in keys if in_view.isdisjoint(tiles_around(key))]
        if stale := [key for key in left if not self._stands(key, min_views)]:
            self._elect(stale, min_views, frusta(), last=True)
        whole = {key for key in left if self._stands(key, min_views)}
        known = frozenset(keys)
        ready = [key for key in left if whole.issuperset(known.intersection(tiles_around(key)))]
        if ready := [key for key in ready if self._is_unfinished(key)]:
            self._finish(ready, frusta())

    def snapshot(self, min_views: int, frusta: ViewFrusta) -> Surface:
        """Return the current surface, without its cloud, as a copy of its own; only changed tiles are elected
        again.

        A tile next to a changed one is elected again only when it changes itself, and whether a view sees a
        height is tested only once unless the height moves.
        """
        keys = self._store.keys()
        changed = [key for key in keys if not self._is_current(key, min_views)]
        self._elect(changed, min_views, frusta, last=False)
        self._heights.hold(len(changed))
        self._finish([key for key in keys if self._is_unfinished(key)], frusta)
        return self._surface(tile_file)

    def finish(self, min_views: int, frusta: ViewFrusta) -> Surface:
        """Return the final surface, which doesn't depend on any snapshots taken before; the tiles in
        `store` are deleted.
        """
        keys = self._store.keys()
        stale = [key for key in keys if not self._stands(key, min_views, frusta)]
        self._elect(stale, min_views, frusta, last=True)
        self._finish([key for key in keys if self._is_unfinished(key)], frusta)
        surface = self._surface(tile_file, cloud_file)
        self._store.clear()
        shutil.rmtree(self._work)
        return surface

    def _is_current(self, key: TileKey, min_views: int) -> bool:
        """Check whether a tile has been elected since its last change."""
        one = self._elections.get(key)
        return one is not None and (one.versions[_MIDDLE], one.min_views) == (
            self._store.version(key), min_views
        )  # fmt: skip

    def _stands(self, key: TileKey, min_views: int, frusta: ViewFrusta | None = None) -> bool:
        """Check whether a tile's election was a final one and is still valid, also for all views of
        `frusta` if given.
        """
        one = self._elections.get(key)
        if (
            one is None
            or not one.is_last
            or (one.versions, one.min_views) != (self._versions(key), min_views)
        ):
            return False
        return (
            frusta is None
            or one.box is None
            or int(frusta.touching(one.box[0], one.box[1]).sum()) == one.near
        )

    def _is_unfinished(self, key: TileKey) -> bool:
        return self._finishes.get(key) != self._around_elected(key)

    def _versions(self, key: TileKey) -> tuple[int, ...]:
        return tuple(self._store.version(near) for near in tiles_around(key))

    def _around_elected(self, key: TileKey) -> tuple[TileElection | None, ...]:
        return tuple(self._elections.get(near) for near in tiles_around(key))

    def _surface(self, *names: Callable[[Path, TileKey], Path]) -> Surface:
        """Gather the finished tiles in a new folder, as links to their files of these names, which are
        never written to again.
        """
        keys = self._store.keys()
        folder = Path(tempfile.mkdtemp(prefix="surface_", dir=self._folder))
        for key in keys:
            for name in names:
                os.link(name(self._finished, key), name(folder, key))
        surface = gather_surface(folder, self._cell_m, {key: self._figures[key] for key in keys})
        weakref.finalize(surface, shutil.rmtree, folder, ignore_errors=True)
        return surface

    def _elect(self, keys: list[TileKey], min_views: int, frusta: ViewFrusta, *, last: bool) -> None:
        """Elect these tiles, using the current vote-only heights of their neighbours; a last election
        doesn't reuse the visibility tests made for snapshots.
        """
        known, read = frozenset(self._store.keys()), self._store.read
        states = {key: (self._store.version(key), min_views) for key in known}
        beside = known.intersection(near for key in keys for near in tiles_around(key))
        voted = [key for key in sorted(beside) if self._voted.get(key) != states[key]]

        def look(key: TileKey, tile: Float32) -> None:
            np.save(first_file(self._first, key), elect_by_votes(tile, min_views, self._settings.top_ratio))

        def elect_tile(key: TileKey, tile: Float32, asked: ViewSupport) -> TileElection:
            around = first_around(self._first, key, known)
            box = supported_box(tile, key, self._cell_m, min_views)
            winner = elect_surface(tile, key, around, frusta, self._cell_m, min_views, self._settings, asked)
            write_tile(self._elected, key, elected_layers(tile, winner))
            if last:
                np.save(_winner_file(self._elected, key), winner)
            else:
                self._views[key] = asked.views
            near = None if box is None else frusta.touching(box[0], box[1])
            height_m = np.nan if near is None else frusta.only(near).height_m
            return TileElection(
                self._versions(key), min_views, last, box, 0 if near is None else int(near.sum()), height_m
            )

        def asked_of(key: TileKey) -> ViewSupport:
            return (
                ViewSupport.none() if last else ViewSupport(self._views.get(key, 0), self._heights.take(key))
            )

        read_first.cache_clear()
        for _ in self._counted(ordered_map(lambda item: look(*item), ((key, read(key)) for key in voted))):
            pass
        self._voted |= {key: states[key] for key in voted}
        items = ((key, read(key), asked_of(key)) for key in keys)
        elections = self._counted(ordered_map(lambda item: elect_tile(*item), items))
        self._elections |= dict(zip(keys, elections, strict=True))

    def _finish(self, keys: list[TileKey], frusta: ViewFrusta) -> None:
        """Average, sharpen and fill these tiles; write the cloud of those whose election is final."""
        known = frozenset(self._store.keys())

        def finish_tile(item: tuple[TileKey, Float32 | None]) -> tuple[TileKey, TileFigures]:
            key, tile = item
            layers, blur = finished_layers(
                self._elected, key, known, frusta, self._seen_from_m(key), self._cell_m, self._settings
            )
            write_tile(self._finished, key, layers)
            if tile is not None:
                winner: Int8 = np.load(_winner_file(self._elected, key))
                part = CloudPart.of(tile, winner, key, self._cell_m, self._elections[key].min_views)
                part.finished(layers.z_m, layers.sigma_m, blur).write(self._finished, key)
            return key, tile_figures(key, layers)

        read_tile.cache_clear()
        items = ((key, self._store.read(key) if self._elections[key].is_last else None) for key in keys)
        self._figures |= self._counted(ordered_map(finish_tile, items))
        self._finishes |= {key: self._around_elected(key) for key in keys}

    def _counted(self, tiles: Iterator[Result]) -> Iterator[Result]:
        for tile in tiles:
            self._beat()
            yield tile

    def _seen_from_m(self, key: TileKey) -> float:
        """Return the height of the cameras that see a tile or, if none does, of those that see its
        neighbours.
        """
        around = [one.height_m for one in self._around_elected(key) if one is not None]
        own = self._elections[key].height_m
        known = [height_m for height_m in around if np.isfinite(height_m)]
        return own if np.isfinite(own) else float(np.median(known)) if known else 0.0


def _winner_file(folder: Path, key: TileKey) -> Path:
    return folder / f"winner_{key[0]}_{key[1]}.npy"
