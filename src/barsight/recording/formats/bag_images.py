"""Convert ROS picture messages to gray pictures, or to PNG files for copying."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import UInt8
from barsight.core.records.gray_levels import TornImageError, to_gray
from barsight.recording.formats.bag_file import COMPRESSED_TYPE
from barsight.recording.image_decoding import JPEG_SIGNATURE, PNG_SIGNATURE, decode_gray, expect_size

# encoding: (dtype, channels, conversion to BGR or gray, None if no conversion is needed)
ENCODINGS: dict[str, tuple[type[np.generic], int, int | None]] = {
    "mono8": (np.uint8, 1, None),
    "8UC1": (np.uint8, 1, None),
    "mono16": (np.uint16, 1, None),
    "16UC1": (np.uint16, 1, None),
    "bgr8": (np.uint8, 3, None),
    "8UC3": (np.uint8, 3, None),
    "rgb8": (np.uint8, 3, cv2.COLOR_RGB2BGR),
    "bgra8": (np.uint8, 4, None),
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2BGRA),
    "bayer_rggb8": (np.uint8, 1, cv2.COLOR_BayerRGGB2GRAY),
    "bayer_bggr8": (np.uint8, 1, cv2.COLOR_BayerBGGR2GRAY),
    "bayer_gbrg8": (np.uint8, 1, cv2.COLOR_BayerGBRG2GRAY),
    "bayer_grbg8": (np.uint8, 1, cv2.COLOR_BayerGRBG2GRAY),
}


def gray_of(kind: str, message: Any, size: tuple[int, int]) -> UInt8:
    """Decode an `Image` or `CompressedImage` to (H, W) uint8. Raises `TornImageError`.

    size: the calibration's width and height.
    """
    if kind == COMPRESSED_TYPE:
        return decode_gray(message.data.tobytes(), size)
    expect_size((int(message.width), int(message.height)), size)
    return to_gray(_pixels(message))


def file_of(kind: str, message: Any) -> tuple[str, bytes]:
    """Encode as a file (suffix, bytes) of the same pixels: a compressed picture's own bytes, otherwise a PNG.

    Raises `TornImageError`.
    """
    if kind == COMPRESSED_TYPE:
        data: bytes = message.data.tobytes()
        if data.startswith(PNG_SIGNATURE):
            return "png", data
        if data.startswith(JPEG_SIGNATURE):
            return "jpg", data
        raise TornImageError(f"is compressed as {message.format!r}; PNG or JPEG is needed")
    done, encoded = cv2.imencode(".png", _pixels(message))
    if not done:
        raise TornImageError("can't be stored as a PNG")
    return "png", encoded.tobytes()


def _pixels(message: Any) -> NDArray[Any]:
    """View the message's pixels in OpenCV's order: (H, W) or (H, W, C), BGR."""
    if message.encoding not in ENCODINGS:
        raise TornImageError(f"has the encoding {message.encoding!r}; {', '.join(ENCODINGS)} are read")
    dtype, channels, conversion = ENCODINGS[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * np.dtype(dtype).itemsize
    if height < 1 or width < 1 or step < row or message.data.size < height * step:
        raise TornImageError(
            f"is cut short: {message.data.size} bytes for {width}x{height} {message.encoding}"
        )
    rows = message.data[: height * step].reshape(height, step)[:, :row]
    stored = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    pixels = np.ascontiguousarray(rows).view(stored).astype(dtype)
    if channels > 1:
        pixels = pixels.reshape(height, width, channels)
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))
