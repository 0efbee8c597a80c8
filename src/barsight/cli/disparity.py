"""`barsight disparity LEFT RIGHT -o FILE`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape

from barsight.calibration.any_rig_file import read_rig_file
from barsight.calibration.rectification import Rectifier
from barsight.cli.arguments import call
from barsight.core.arrays import UInt8
from barsight.core.errors import (
    CalibrationError,
    ConfigError,
    Failed,
    InputError,
    MeasurementError,
    OutputError,
)
from barsight.core.types import Disparity, DisparityRange, RectifiedPair, StereoFrame
from barsight.evaluation.stereo_scenes import pair_from_images
from barsight.mapping.view import disparity_range
from barsight.measurement import Preview
from barsight.recording.images import TornImageError, decode_with_colour
from barsight.report.files import write_preview
from barsight.stereo.disparity_files import write_disparity
from barsight.stereo.disparity_range import nothing_to_match
from barsight.stereo.rows import MOST_OFFSET_PX, vertical_offset
from barsight.stereo.settings import MethodName, StereoSettings, make_method

_IN_COLOUR: tuple[MethodName, ...] = ("csca",)
"""Methods that look at colours."""
_REMEDIES = {
    "swapped": "exchange the two pictures or give --range A:B",
    "same-image": "give two pictures of one pair",
}
_POOR = "warning: hardly anything is matched well: two pictures of one pair, bright and sharp enough?"
_LEAST_SIZE = (3, 16)
"""Rows and columns below which nothing is matched."""
_POOR_SIGMA_PX = 0.7
"""Lower quartile of our own sigma: sound pairs (Middlebury, EuRoC, KITTI, a yard) have 0.06 to 0.45, noise,
pictures of different scenes and pictures drowned in noise 1.0 to 42."""
SUFFIXES = (".pfm", ".png", ".tif", ".tiff")


def run(arguments: Sequence[str]) -> None:
    """Parse and match."""

    def command(
        left: tyro.conf.Positional[Path],
        right: tyro.conf.Positional[Path],
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        rig: Path | None = None,
        range: str | None = None,
        preview: Path | None = None,
        settings: Annotated[StereoSettings, tyro.conf.arg(name="")] = StereoSettings(),  # noqa: B008
    ) -> None:
        """Match one pair: the left picture's disparity, in pixels, with a sigma per pixel in a .tif.

        Args:
            left: The left picture, rectified unless a rig is given; colour and 16 bits are turned to grey,
                but `csca` looks at the colours too.
            right: The right picture.
            out: The file to write: .pfm, .png (16 bits, disparity times 256) or .tif (disparity and sigma).
            rig: Rig file (ours, Kalibr's, OpenCV's) or EuRoC folder: the pictures are raw and get rectified.
            range: Candidates A:B in px; found from the pictures when not given.
            preview: PNG to write with the left picture beside the disparity in colours.
            settings: The method and its settings.
        """
        console = Console(stderr=True)
        if out.suffix.lower() not in SUFFIXES:
            raise OutputError(f"{out}: disparities are written as {', '.join(SUFFIXES)}")
        if range is not None:
            low, high = _parsed_range(range)
            settings = replace(settings, lowest_disparity_px=low, highest_disparity_px=high)
        pair = _pair(left, right, rig, settings.method)
        candidates = disparity_range(pair, settings)
        if isinstance(candidates, Failed):
            if candidates.code not in _REMEDIES:
                raise MeasurementError(f"{left}: {candidates.reason}")
            raise InputError(left, candidates.reason, _REMEDIES[candidates.code])
        _expect_inside(candidates, pair)
        disparity = make_method(settings)(pair, candidates)
        if disparity.coverage == 0:
            span = f"no pixel has a match from {candidates.lowest_px} to {candidates.highest_px} px"
            raise MeasurementError(f"{left}: {nothing_to_match(pair) or span}")
        write_disparity(out, disparity)
        if preview is not None:
            write_preview(Preview(pair.left, disparity.disparity_px), preview)
        console.print(_summary(out, disparity), soft_wrap=True, highlight=False)
        if settings.method == "barsight" and np.nanpercentile(disparity.sigma_px, 25) > _POOR_SIGMA_PX:
            console.print(_POOR, soft_wrap=True, highlight=False)

    call(command, "disparity", arguments)


def _summary(out: Path, disparity: Disparity) -> str:
    found = disparity.disparity_px[np.isfinite(disparity.disparity_px)]
    return (
        f"{escape(str(out))}: {100 * disparity.coverage:.1f} % of the pixels, {found.min():.2f} to "
        f"{found.max():.2f} px, median sigma {np.nanmedian(disparity.sigma_px):.3f} px"
    )


def _pair(left: Path, right: Path, rig: Path | None, method: MethodName) -> RectifiedPair:
    """The rectified pair. Raises InputError where the pictures can't be read, differ in size or rows."""
    (left_grey, left_colour), (right_grey, right_colour) = _read(left), _read(right)
    frame = StereoFrame(0, left_grey, right_grey)
    colours = None
    if method in _IN_COLOUR and left_colour is not None and right_colour is not None:
        colours = left_colour, right_colour
    if rig is not None:
        rectifier = Rectifier(read_rig_file(rig))
        pair = rectifier(frame)
        if isinstance(pair, Failed):
            raise CalibrationError(rig, pair.reason, "give the rig of these pictures")
        if colours is not None:
            pair = _with_colours(pair, rectifier, *colours)
    else:
        if frame.left.shape != frame.right.shape:
            sizes = " and ".join(f"{i.shape[1]}x{i.shape[0]}" for i in (frame.left, frame.right))
            raise InputError(right, f"the pictures' sizes differ ({sizes})", "give two pictures of one pair")
        pair = pair_from_images(frame.left, frame.right, *(colours or ()))
    if any(side < least for side, least in zip(pair.left.shape, _LEAST_SIZE, strict=True)):
        rows, columns = _LEAST_SIZE
        size = f"{pair.camera.width}x{pair.camera.height}"
        raise InputError(left, f"is {size}: {columns}x{rows} at least can be matched", "give whole pictures")
    offset = vertical_offset(pair.left, pair.right)
    if not isinstance(offset, Failed) and offset > MOST_OFFSET_PX:
        remedy = "give the rig of these pictures" if rig else "rectify the pictures, or give their --rig"
        raise InputError(
            left, f"the pair is not rectified: matches lie {offset:.1f} px off their rows", remedy
        )
    return pair


def _with_colours(pair: RectifiedPair, rectifier: Rectifier, left: UInt8, right: UInt8) -> RectifiedPair:
    channels = [rectifier(StereoFrame(0, left[:, :, one], right[:, :, one])) for one in range(3)]
    pairs = [one for one in channels if not isinstance(one, Failed)]
    left, right = np.dstack([one.left for one in pairs]), np.dstack([one.right for one in pairs])
    return replace(pair, left_colour=left, right_colour=right)


def _read(path: Path) -> tuple[UInt8, UInt8 | None]:
    try:
        return decode_with_colour(path.read_bytes())
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "check the name") from error
    except TornImageError as error:
        raise InputError(path, str(error), "give another picture") from error


def _parsed_range(text: str) -> tuple[int, int]:
    try:
        low, high = (int(part) for part in text.split(":"))
    except ValueError as error:
        raise ConfigError(f"--range takes A:B in whole pixels, not {text!r}") from error
    return low, high


def _expect_inside(candidates: DisparityRange, pair: RectifiedPair) -> None:
    """Raises ConfigError where no candidate, or more than the picture's width of them, can be."""
    width = pair.camera.width
    if candidates.lowest_px >= width or candidates.highest_px <= -width or candidates.count > width:
        raise ConfigError(
            f"the range {candidates.lowest_px}:{candidates.highest_px} doesn't fit a picture {width} px wide"
        )
