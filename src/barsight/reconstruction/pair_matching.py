"""Compute the disparity of one pair of pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from barsight.calibration.files.rig_formats import read_rig_file
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import UInt8
from barsight.core.errors import CalibrationError, ConfigError, Failed, InputError, MeasurementError
from barsight.core.reading.bounded_reading import read_bytes
from barsight.core.records.disparity import Disparity
from barsight.core.records.gray_levels import TornImageError, split_colour
from barsight.core.records.pairs import PICTURE_REMEDY, RectifiedPair, StereoFrame
from barsight.mapping.view import disparity_range
from barsight.recording.image_decoding import MAX_PICTURE_BYTES, decode_with_colour
from barsight.stereo.image_pair import pair_from_images
from barsight.stereo.search_range import check_matchable
from barsight.stereo.settings import MethodName, StereoSettings, make_method
from barsight.stereo.vertical_offset import MAX_OFFSET_PX, vertical_offset

Picture = Path | UInt8
"""A file, or an array (H, W) uint8."""
_IN_COLOUR: tuple[MethodName, ...] = ("csca",)
"""Methods that use colour."""
_REMEDIES = {
    "swapped": "exchange the two pictures or give the range of disparities",
    "same-image": "give two pictures of one pair",
}
_MIN_SIZE = (3, 16)
"""Minimum numbers of rows and columns of a picture that can be matched."""


def match_pictures(
    left: Picture, right: Picture, settings: StereoSettings, rig: Path | StereoRig | None = None
) -> tuple[RectifiedPair, Disparity]:
    """Match two pictures, which must be rectified unless a rig is given; return the rectified pair and its
    disparity.

    Raises InputError, CalibrationError, ConfigError or MeasurementError where they can't be matched.
    """
    pair = _pair(left, right, rig, settings.method)
    candidates = disparity_range(pair, settings)
    if isinstance(candidates, Failed):
        if candidates.code not in _REMEDIES:
            raise MeasurementError(f"{_name(left)}: {candidates.reason}")
        raise InputError(_name(left), candidates.reason, _REMEDIES[candidates.code])
    if not candidates.fits(pair.camera.width):
        span = f"{candidates.lowest_px}:{candidates.highest_px}"
        raise ConfigError(f"the range {span} doesn't fit a picture {pair.camera.width} px wide")
    disparity = make_method(settings)(pair, candidates)
    if disparity.coverage == 0:
        span = f"no pixel has a match from {candidates.lowest_px} to {candidates.highest_px} px"
        raise MeasurementError(f"{_name(left)}: {check_matchable(pair) or span}")
    return pair, disparity


def _name(picture: Picture, side: str = "left") -> Path:
    """Name a picture by its file, or as the argument `side`."""
    return picture if isinstance(picture, Path) else Path(side)


def _pair(left: Picture, right: Picture, rig: Path | StereoRig | None, method: MethodName) -> RectifiedPair:
    """Load the rectified pair. Raises InputError where the pictures can't be read, differ in size, are too
    small or aren't rectified, and CalibrationError where the rig doesn't fit them.
    """
    (left_gray, left_colour), (right_gray, right_colour) = _read(left, "left"), _read(right, "right")
    frame = StereoFrame(0, left_gray, right_gray)
    colours = None
    if method in _IN_COLOUR and left_colour is not None and right_colour is not None:
        colours = left_colour, right_colour
    if rig is not None:
        rectifier = Rectifier(rig if isinstance(rig, StereoRig) else read_rig_file(rig))
        pair = rectifier(frame)
        if isinstance(pair, Failed):
            named = rig if isinstance(rig, Path) else _name(left)
            raise CalibrationError(named, pair.reason, "give the rig of these pictures")
        if colours is not None:
            pair = _with_colours(pair, rectifier, *colours)
    else:
        if frame.left.shape != frame.right.shape:
            sizes = " and ".join(f"{i.shape[1]}x{i.shape[0]}" for i in (frame.left, frame.right))
            raise InputError(
                _name(right, "right"),
                f"the pictures' sizes differ ({sizes})",
                "give two pictures of one pair",
            )
        pair = pair_from_images(frame.left, frame.right, *(colours or ()))
    if any(side < least for side, least in zip(pair.left.shape, _MIN_SIZE, strict=True)):
        rows, columns = _MIN_SIZE
        size = f"{pair.camera.width}x{pair.camera.height}"
        raise InputError(
            _name(left), f"is {size}: it must be at least {columns}x{rows}", "give whole pictures"
        )
    offset = vertical_offset(pair.left, pair.right)
    if not isinstance(offset, Failed) and offset > MAX_OFFSET_PX:
        remedy = "give the rig of these pictures" if rig else "rectify the pictures, or give their rig"
        raise InputError(
            _name(left), f"the pair is not rectified: matches lie {offset:.1f} px off their rows", remedy
        )
    return pair


def _with_colours(pair: RectifiedPair, rectifier: Rectifier, left: UInt8, right: UInt8) -> RectifiedPair:
    channels = [rectifier(StereoFrame(0, left[:, :, one], right[:, :, one])) for one in range(3)]
    pairs = [one for one in channels if not isinstance(one, Failed)]
    left, right = np.dstack([one.left for one in pairs]), np.dstack([one.right for one in pairs])
    return replace(pair, left_colour=left, right_colour=right)


def _read(path: Picture, side: str) -> tuple[UInt8, UInt8 | None]:
    try:
        if not isinstance(path, Path):
            return split_colour(np.asanyarray(path))
        return decode_with_colour(read_bytes(path, MAX_PICTURE_BYTES, "check the name"))
    except TornImageError as error:
        remedy = "give another picture" if isinstance(path, Path) else PICTURE_REMEDY
        raise InputError(_name(path, side), str(error), remedy) from error
