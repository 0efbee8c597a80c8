"""Load rectified pairs with true disparity from Middlebury-style folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8
from barsight.core.errors import InputError
from barsight.core.records.disparity import DisparityRange
from barsight.core.records.gray_levels import TornImageError
from barsight.core.records.pairs import RectifiedPair
from barsight.recording.image_decoding import decode_with_colour
from barsight.stereo.disparity_files import read_disparity
from barsight.stereo.image_pair import pair_from_images

_BRIGHTEST_16_BIT = 257


@dataclass(frozen=True, eq=False)
class StereoScene:
    """A rectified pair with its truth. truth_px: (H, W) true disparity of the left image, NaN where
    unknown. counted: (H, W) bool, the pixels that are scored. mask: their origin, `nonocc.png` (visible in
    both images) or `known` (every pixel with truth). candidates: disparity range that every method is
    given.
    """

    name: str
    pair: RectifiedPair
    truth_px: Float32
    counted: Bool
    mask: str
    candidates: DisparityRange

    @property
    def megapixels(self) -> float:
        """Return the left image's size, megapixels."""
        return self.truth_px.size / 1e6


def load_scenes(data: Path) -> tuple[StereoScene, ...]:
    """Load the scenes in `data`: a folder of scene folders, or one scene's folder. Raises `InputError`."""
    if (data / "disp.pfm").is_file():
        return (load_scene(data),)
    if not data.is_dir():
        raise InputError(
            data, "is not a folder", "name one that holds scenes with left.png, right.png, disp.pfm"
        )
    folders = sorted(path for path in data.iterdir() if (path / "disp.pfm").is_file())
    if not folders:
        raise InputError(data, "holds no scene", "a scene is a folder with left.png, right.png and disp.pfm")
    return tuple(load_scene(folder) for folder in folders)


def load_scene(folder: Path) -> StereoScene:
    """Load one folder: left.png, right.png, disp.pfm [nonocc.png, white for pixels visible in both images].

    Without nonocc.png every pixel with known truth is scored. The candidates run from 0 (or the lowest true
    disparity if that is negative) to the next multiple of 16 above the highest one.
    """
    left, right = _read_gray(folder / "left.png"), _read_gray(folder / "right.png")
    if left.shape != right.shape:
        raise InputError(folder, f"left is {left.shape}, right is {right.shape}", "a pair has one size")
    truth = read_disparity(folder / "disp.pfm").disparity_px
    if truth.shape != left.shape:
        raise InputError(
            folder / "disp.pfm", f"is {truth.shape}, the images are {left.shape}", "fetch it again"
        )
    if not np.isfinite(truth).any():
        raise InputError(folder / "disp.pfm", "has no known disparity", "fetch it again")
    mask_path = folder / "nonocc.png"
    counted = np.isfinite(truth)
    if mask_path.is_file():
        counted &= _read_gray(mask_path) == 255
    lowest = min(0, int(np.floor(np.nanmin(truth))))
    count = int(np.floor(np.nanmax(truth))) + 2 - lowest
    return StereoScene(
        name=folder.name,
        pair=pair_from_images(
            left, right, *(_read_colour(folder / name) for name in ("left.png", "right.png"))
        ),
        truth_px=truth,
        counted=counted,
        mask=mask_path.name if mask_path.is_file() else "known",
        candidates=DisparityRange(lowest, lowest + -(-count // 16) * 16),
    )


def _read_colour(path: Path) -> UInt8 | None:
    try:
        return decode_with_colour(path.read_bytes())[1]
    except TornImageError as error:
        raise InputError(path, str(error), "fetch it again") from error


def _read_gray(path: Path) -> UInt8:
    try:
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise InputError(path, f"can't be read ({error.strerror})", "check the folder") from error
    image = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE) if data.size else None
    if image is None:
        raise InputError(path, "is not a readable picture", "fetch it again")
    if image.dtype == np.uint16:
        image = ((image.astype(np.uint32) + _BRIGHTEST_16_BIT // 2) // _BRIGHTEST_16_BIT).astype(np.uint8)
    gray: UInt8 = np.ascontiguousarray(image, dtype=np.uint8)
    return gray
