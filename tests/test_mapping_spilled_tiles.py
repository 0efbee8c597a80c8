"""Tiles that don't fit in memory come back from their files as they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from barsight.mapping.spilled_tiles import SpilledTiles


def test_spilled_tiles_are_those_of_a_dictionary(tmp_path: Path) -> None:
    rng, kept = np.random.default_rng(1), dict[tuple[int, int], np.ndarray]()
    tiles = SpilledTiles(tmp_path, resident=3)
    for _ in range(400):
        key = int(rng.integers(-3, 3)), int(rng.integers(0, 2))
        for store in (tiles, kept):
            store.setdefault(key, np.zeros((2, 4), np.uint16))
        place, value = tuple(rng.integers(0, (2, 4))), rng.integers(1, 99)
        tiles[key][place] += value
        kept[key][place] += value
    assert len(tiles) == len(kept) == 12 and list(tiles) == sorted(kept)
    assert len(list(tmp_path.rglob("*.npy"))) >= 9
    for key, tile in tiles.items():
        np.testing.assert_array_equal(tile, kept[key])
        np.testing.assert_array_equal(tiles.peek(key), kept[key])
    files = len(list(tmp_path.rglob("*.npy")))
    assert tiles.get((9, 9)) is None and len(list(tmp_path.rglob("*.npy"))) == files
    del tiles[0, 0]
    assert (0, 0) not in tiles and len(tiles) == 11
    with pytest.raises(KeyError):
        tiles[0, 0]
    tiles.hold(0)
    assert len(list(tmp_path.rglob("*.npy"))) == 11
    tiles.clear()
    assert not tiles and not list(tmp_path.rglob("*.npy"))


def test_two_stores_in_one_folder_are_apart(tmp_path: Path) -> None:
    one, other = SpilledTiles(tmp_path, resident=1), SpilledTiles(tmp_path, resident=1)
    for number in range(4):
        one[number, 0], other[number, 0] = np.full(3, number), np.full(3, -number)
    assert [tile[0] for tile in one.values()] == [0, 1, 2, 3]
    assert [tile[0] for tile in other.values()] == [0, -1, -2, -3]
