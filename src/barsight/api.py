"""Define the Python API of `import barsight as bs`, each function a thin call of the library."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

from barsight.board_views import MIN_VIEWS, views_from_pictures
from barsight.calibration.boards.board import parse_board
from barsight.calibration.geometry.projection import Lens
from barsight.calibration.geometry.rig import StereoRig
from barsight.calibration.stereo.calibration import StereoCalibration
from barsight.calibration.stereo.calibration import calibrate_stereo as solve_stereo
from barsight.calibration.stereo.verdict import MAX_RANGE_M, MIN_RANGE_M, Verdict, assess, summary_sentence
from barsight.core.arrays import UInt8
from barsight.core.errors import ConfigError
from barsight.core.records.disparity import Disparity
from barsight.core.settings.values import build_settings, checked_value, expect_choice
from barsight.core.timing import ProgressCallback
from barsight.measure_folder import ignore_progress, measure_into
from barsight.measure_settings import MeasureSettings
from barsight.reconstruction.pair_matching import match_pictures
from barsight.recording.open import open_recording as open_path
from barsight.recording.packets import packets as packets
from barsight.recording.stored_images import StoredPictures
from barsight.result import TemporaryFolder, Yard
from barsight.stereo.settings import StereoSettings


def open_recording(path: Path | str) -> StoredPictures:
    """Return the recording at `path`: an EuRoC folder, a ROS bag or a KITTI sequence. Raises InputError."""
    return open_path(checked_value(path, Path, "path"))


def measure(
    recording: Path | str | Sequence[Path | str],
    /,
    *,
    preset: Literal["best", "fast"] = "best",
    magnet: Path | str | None = None,
    at: Literal["now", "end"] = "now",
    advance: ProgressCallback = ignore_progress,
    **settings: Any,
) -> Yard:
    """Measure a recording; the files are in a temporary folder, which is deleted with the yard unless saved.

    recording: one, or several passes over one yard, which become one map.

    magnet: TOML file of the magnet that lifts are chosen for; without it none is offered. at: time at which
    lifts are judged: now, or the recording's end, in retrospect. advance: called with progress (stage, done,
    total). settings: fields of `MeasureSettings`; those of a stage as a mapping, `map={"cell_m": 0.02}`.
    Raises a BarsightError with a one-line text if nothing can be measured.
    """
    chosen = build_settings({"preset": preset, **settings}, MeasureSettings)
    described = checked_value(magnet, Path | None, "magnet")
    passes = _paths(recording)
    temporary = TemporaryFolder()
    out = temporary.path
    try:
        measure_into(passes, out, chosen, advance=advance, magnet=described, judged_at=at, report=False)
    except BaseException:
        temporary.delete()  # a notebook keeps the error, and what its frames hold
        raise
    return Yard(out, temporary)


def _paths(recording: Any) -> list[Path]:
    """Return the paths of one or several passes. Raises ConfigError for anything else."""
    is_one = isinstance(recording, (str, bytes, os.PathLike)) or not isinstance(recording, Iterable)
    passes = (recording,) if is_one else tuple(recording)
    try:
        return list(checked_value(passes, tuple[Path, ...], "recording"))
    except ConfigError as error:
        raise ConfigError(f"{error}, or a list of paths, or push packets to a Session") from None


def load(folder: Path | str) -> Yard:
    """Return the yard of a folder written by `barsight measure` or `Yard.save`. Raises InputError."""
    return Yard(folder)


def disparity(
    left: Path | str | UInt8,
    right: Path | str | UInt8,
    *,
    rig: Path | str | StereoRig | None = None,
    range_px: tuple[int, int] | None = None,
    **settings: Any,
) -> Disparity:
    """Match two pictures: the left one's disparity and its sigma, px, NaN without a match.

    left, right: files or (H, W) uint8, rectified unless a rig is given. range_px: first candidate, and the
    end, which isn't one; determined from the pictures if None. settings: fields of `StereoSettings`.
    """
    if range_px is not None:
        low, high = checked_value(range_px, tuple[int, int], "range_px")
        if twice := settings.keys() & {"min_disparity_px", "max_disparity_px"}:
            raise ConfigError(f"range_px and {min(twice)} are given; leave one of them out")
        settings |= {"min_disparity_px": low, "max_disparity_px": high}
    chosen = build_settings(settings, StereoSettings)
    first, second = (Path(one) if isinstance(one, (str, os.PathLike)) else one for one in (left, right))
    by = rig if isinstance(rig, StereoRig) else checked_value(rig, Path | None, "rig")
    return match_pictures(first, second, chosen, by)[1]


def calibrate_stereo(
    pictures: Path | str, board: str, *, lens: str = Lens.RADTAN4.value, range_m: float = 7.0,
    max_views: int = 150,
) -> StereoCalibration:  # fmt: skip
    """Calibrate two cameras from pictures of a board seen by both; `.rig` is the input for measuring, and
    `save` writes the file that also states its uncertainty.

    The arguments are those of `barsight calibrate stereo`. Warns if the verdict is redo.
    """
    expect_choice("lens", lens, tuple(one.value for one in Lens))
    target, path = parse_board(checked_value(board, str, "board")), checked_value(pictures, Path, "pictures")
    if checked_value(max_views, int, "max_views") < MIN_VIEWS:
        raise ConfigError(f"max_views is {max_views}; give {MIN_VIEWS} or more")
    if not MIN_RANGE_M <= checked_value(range_m, float, "range_m") <= MAX_RANGE_M:
        raise ConfigError(f"range_m is {range_m:g}; give the working distance in metres")
    views, sizes, left_out = views_from_pictures(path, target, max_views, ignore_progress)
    calibration = solve_stereo(views, target, Lens(lens), sizes, path, left_out)
    judged = assess(calibration, range_m)
    if judged.verdict is Verdict.REDO:
        why = summary_sentence(judged.lines)
        warnings.warn(f"{path}: redo the calibration, don't measure with it: {why}", stacklevel=2)
    return calibration
