"""Collect views of a calibration board from pictures, recordings or files of detections."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from barsight.calibration.boards.board import Board
from barsight.calibration.boards.board_views import BoardView, Corners, Removed
from barsight.calibration.boards.detection import detect
from barsight.calibration.boards.detection_files import read_detections
from barsight.core.errors import ConfigError, Failed, InputError
from barsight.core.parallel import ordered_map
from barsight.core.records.pairs import RefusedFrame
from barsight.recording.formats.bag_file import BAG_KINDS
from barsight.recording.formats.image_pairs import ReadPair, find_pairs, read_pair_files
from barsight.recording.open import open_recording

MIN_VIEWS = 6
"""Minimum of the maximum number of views of a board that a calibration is asked to use."""

Size = tuple[int, int]


def views_from_detections(
    folder: Path, board: Board, max_views: int, resolution: str | None
) -> tuple[list[BoardView], tuple[Size, Size], list[Removed]]:
    """Read the views in a folder of detections, the cameras' sizes and the views left out.

    resolution: WIDTHxHEIGHT of the cameras. Raises ConfigError without it.
    """
    try:
        width, height = (int(part) for part in (resolution or "").lower().split("x"))
    except ValueError:
        raise ConfigError(
            f"detections need the cameras' resolution as WIDTHxHEIGHT, not {resolution!r}"
        ) from None
    views = read_detections(folder, board)
    chosen = np.unique(np.linspace(0, len(views) - 1, min(max_views, len(views))).astype(int))
    return [views[n] for n in chosen], ((width, height), (width, height)), []


def views_from_pictures(
    path: Path, board: Board, max_views: int, advance: Callable[[str, int, int], None]
) -> tuple[list[BoardView], tuple[Size, Size], list[Removed]]:
    """Detect the board in pairs of pictures, or of a bag: views, the cameras' sizes, views left out."""
    count, pairs = _pairs(path, max_views)
    views: list[BoardView] = []
    left_out: list[Removed] = []
    sizes: list[Size | None] = [None, None]
    found = ordered_map(lambda pair: _detected(board, pair), pairs)
    for done, (pair, corners) in enumerate(found, 1):
        advance("corners", done, count)
        left_out += [Removed(pair.name, camera, reason) for camera, reason in pair.problems]
        usable: list[Corners | None] = [None, None]
        for camera, (image, result) in enumerate(zip((pair.left, pair.right), corners, strict=True)):
            if image is None or result is None:
                continue
            size = (image.shape[1], image.shape[0])
            first = sizes[camera] or size
            sizes[camera] = first
            if size != first:
                reason = f"is {size[0]}x{size[1]}, the first picture is {first[0]}x{first[1]}"
                left_out.append(Removed(pair.name, f"cam{camera}", f"{reason}: of another camera"))
            elif isinstance(result, Failed):
                left_out.append(Removed(pair.name, f"cam{camera}", result.reason))
            else:
                usable[camera] = result
        if usable != [None, None]:
            views.append(BoardView(pair.name, usable[0], usable[1]))
    if sizes[0] is None or sizes[1] is None:
        raise InputError(path, "no picture can be read", "check the files")
    return views, (sizes[0], sizes[1]), left_out


def _pairs(path: Path, max_pairs: int) -> tuple[int, Sequence[ReadPair] | map[ReadPair]]:
    """Count and yield the pairs: of a bag through its reader, of a folder file by file."""
    is_bag = path.suffix in BAG_KINDS or (path / "metadata.yaml").is_file()
    if is_bag:
        recording = open_recording(path)
        total = len(recording.index.stamps_ns)
        step = max(-(-total // max_pairs), 1)
        frames = [frame for n, frame in enumerate(recording.frames()) if n % step == 0]
        return len(frames), [
            ReadPair(str(f.stamp_ns), None, None, (("both", f.reason),))
            if isinstance(f, RefusedFrame)
            else ReadPair(str(f.stamp_ns), f.left, f.right, ())
            for f in frames
        ]
    found = find_pairs(path)
    chosen = np.unique(np.linspace(0, len(found) - 1, min(max_pairs, len(found))).astype(int))
    return len(chosen), map(read_pair_files, [found[n] for n in chosen])


def _detected(board: Board, pair: ReadPair) -> tuple[ReadPair, list[Corners | Failed | None]]:
    return pair, [None if image is None else detect(board, image) for image in (pair.left, pair.right)]
