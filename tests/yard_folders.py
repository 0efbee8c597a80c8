"""A small measured folder as `barsight measure` would leave it, as far as lifts need it."""

from __future__ import annotations

import json
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile

from barsight.cli.main import run
from barsight.core.stamps import NS_PER_S
from barsight.result_folder import seal_map
from barsight.yard.inventory.bundle_file import write_bundles
from barsight.yard.magnet.description import example_magnet
from barsight.yard.types import HeightMap
from lift_yards import laid, map_of, record, sure_travel
from result_folders import summary
from yard_maps import Laid

STOCK = [laid(0.3), laid(0.65)]


def schema(name: str) -> dict[str, Any]:
    """The JSON Schema of `bundles` or `lifts`."""
    text = files("barsight.yard").joinpath(f"schemas/{name}.schema.json").read_text("utf-8")
    content: dict[str, Any] = json.loads(text)
    return content


def lifts(folder: Path, *arguments: str) -> int:
    """Choose lifts for the package's example magnet, given as a file."""
    magnet = folder.parent / "magnet.toml"
    magnet.write_text(example_magnet(), encoding="utf-8")
    return run(["lifts", str(folder), "--magnet", str(magnet), *arguments])


def write_folder(
    folder: Path,
    *,
    shift_m: float = 0.0,
    age_s: float = 0.0,
    more: tuple[Laid, ...] = (),
    block_m: float = 0.0,
    **changes: object,
) -> Path:
    """Two bundles and more. block_m: how far something stands over the second's top, under the last pole."""
    folder.mkdir()
    stock = [laid(0.3 + shift_m), laid(0.65), *more]
    heights = map_of(stock)
    if block_m:
        rows = np.abs(heights.y_m - 2.0) < 0.05
        columns = np.abs(heights.x_m - 0.65) < 0.03
        heights.z_m[np.ix_(rows, columns)] = stock[1].top_z_m + block_m
    place = write_heights(heights, folder / "height.tif")
    photo = np.full(heights.z_m.shape, 90, np.uint8)
    for name in ("ortho.tif", "tops.tif"):
        tifffile.imwrite(
            folder / name, photo, photometric="minisblack", tile=(256, 256), metadata=None, extratags=place
        )
    (folder / "ortho.png").write_bytes(cv2.imencode(".png", photo)[1].tobytes())
    bundles = tuple(record(one, k) for k, one in enumerate(stock))
    stamps = np.array([time.time_ns() - round((age_s + k) * NS_PER_S) for k in (2, 1, 0)], np.int64)
    way = sure_travel(np.zeros((3, 2)), stamps)
    captured = {"captured_from_ns": int(stamps[0]), "captured_to_ns": int(stamps[-1])}
    content = summary() | {"agreement": [], "travel": way.content()} | captured | changes
    identity = seal_map(content, folder)
    (folder / "result.json").write_text(json.dumps(content), encoding="utf-8")
    write_bundles(bundles, None, "yard", identity, folder / "bundles.json")
    return folder


def write_heights(heights: HeightMap, path: Path) -> list[tuple[Any, ...]]:
    """Write height.tif; return the tags that place it, for the other layers of the map."""
    bands = np.stack([heights.z_m, heights.sigma_m, heights.views, heights.source.astype(np.float32)])
    top = heights.y0_m + (heights.z_m.shape[0] - 0.5) * heights.cell_m
    place = [
        (33550, "d", 3, (heights.cell_m, heights.cell_m, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, heights.x0_m - heights.cell_m / 2, top, 0.0), True),
    ]
    tifffile.imwrite(
        path, np.ascontiguousarray(bands[:, ::-1]), photometric="minisblack", planarconfig="separate",
        tile=(256, 256), metadata=None, extratags=place,
    )  # fmt: skip
    return place
