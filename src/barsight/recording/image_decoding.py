"""Decode stored pictures to (H, W) uint8 gray, refusing damaged ones.

OpenCV fills the missing rows of a truncated PNG or JPEG with gray and reports it on stderr only, so a picture
is checked before it is decoded: a PNG chunk by chunk with its checksums, a JPEG by its end marker. Kinds that
OpenCV decodes to wrong values are refused.
"""

from __future__ import annotations

import re
import struct
import zlib
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tifffile import PHOTOMETRIC, TiffFile

from barsight.calibration.geometry.camera import MAX_PIXELS
from barsight.core.arrays import UInt8
from barsight.core.records.gray_levels import TornImageError, split_colour, to_gray

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_KINDS = {
    bytes((depth, colour))
    for colour, depths in {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}.items()
    for depth in depths
}
"""Valid combinations of bits per sample and colour type [PNG spec 11.2.2]."""
JPEG_SIGNATURE = b"\xff\xd8\xff"


MAX_PICTURE_BYTES = 1 << 28
_MISREAD = ("CMYK", "SEPARATED", "LAB", "CIELAB", "ICCLAB", "ITULAB", "CFA", "LINEAR_RAW", "LOGL", "LOGLUV")
"""Kinds of pixels, as Pillow and tifffile name them, whose gray values OpenCV gets wrong or can't know."""
_PNM_HEADER = re.compile(rb"P[2356](?:\s+(?:#[^\n]*\n\s*)*\d+){2}\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s")
"""Header of a PNM up to its largest value, which OpenCV ignores."""


def decode_gray(data: bytes, size: tuple[int, int] | None = None, max_pixels: int = MAX_PIXELS) -> UInt8:
    """Decode the bytes of a PNG, JPEG, TIFF, BMP, PNM or WebP to (H, W) uint8.

    size: the required width and height; max_pixels: limit of width times height. Raises `TornImageError` for
    a picture that is cut short, damaged, of an unknown kind, of another size or too large.
    """
    return to_gray(_decoded(data, size, max_pixels))


def decode_with_colour(data: bytes) -> tuple[UInt8, UInt8 | None]:
    """Decode to gray and to (H, W, 3) uint8 BGR, None if the picture contains only gray values."""
    return split_colour(_decoded(data))


def expect_size(found: tuple[int, int], size: tuple[int, int]) -> None:
    """Raise `TornImageError` if a picture's width and height aren't those of its calibration."""
    if found != size:
        raise TornImageError(f"is {found[0]}x{found[1]}, the calibration is for {size[0]}x{size[1]}")


def _header_size(data: bytes) -> tuple[int, int]:
    """Read width and height without decoding. Raises `TornImageError`."""
    if data.startswith(PNG_SIGNATURE):
        return check_png(data)
    if data.startswith(JPEG_SIGNATURE) and b"\xff\xd9" not in data[-64:]:
        raise TornImageError("is a JPEG cut short (no end marker)")
    try:
        if data.startswith((b"II", b"MM")):
            with TiffFile(BytesIO(data)) as file:
                page = file.pages.first
                kind, bits = PHOTOMETRIC(page.photometric).name, page.bitspersample
                size = page.imagewidth, page.imagelength
        else:
            with Image.open(BytesIO(data), formats=("JPEG", "BMP", "PPM", "WEBP")) as picture:
                kind, bits, size = picture.mode, 8, picture.size
    except Exception:  # Pillow and tifffile raise many types for a damaged header
        raise TornImageError("is not a readable picture") from None
    if kind in _MISREAD or (kind == "MINISWHITE" and bits != 8):
        raise TornImageError(f"has pixels of the kind {kind}; gray or RGB is read")
    if (most := _PNM_HEADER.match(data)) and int(most[1]) not in (255, 65535):
        raise TornImageError(f"has gray levels up to {int(most[1])}; up to 255 or 65535 are read")
    return size


def _decoded(data: bytes, size: tuple[int, int] | None = None, max_pixels: int = MAX_PIXELS) -> NDArray[Any]:
    if not data:
        raise TornImageError("is empty")
    width, height = _header_size(data)
    if size is not None:
        expect_size((width, height), size)
    if width * height > max_pixels:
        raise TornImageError(f"is {width}x{height}, at most {max_pixels} pixels are read")
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != (height, width):
        raise TornImageError("is not a readable picture")
    return np.asarray(image)


def check_png(data: bytes) -> tuple[int, int]:
    """Check a PNG's chunks, lengths and checksums. Raises `TornImageError`. [PNG spec 5.3]

    Returns width and height.
    """
    view = memoryview(data)
    place, size = len(PNG_SIGNATURE), (0, 0)
    has_pixels = False
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        kind = data[place + 4 : place + 8]
        end = place + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(view[place + 4 : end - 4]) != checksum:
            raise TornImageError(f"is a damaged PNG (wrong checksum in its {kind.decode('latin-1')} part)")
        if kind == b"IHDR":
            kind_of_png, rest = data[place + 16 : place + 18], data[place + 18 : place + 20]
            if length != 13 or kind_of_png not in _PNG_KINDS or any(rest) or data[place + 20] > 1:
                raise TornImageError("is a PNG of a kind that there isn't")
            size = struct.unpack_from(">II", data, place + 8)
        elif kind == b"IDAT":
            has_pixels = True
        elif kind == b"IEND":
            if not has_pixels or min(size) < 1:
                raise TornImageError("is a PNG without pixels")
            return size
        place = end
    raise TornImageError(f"is a PNG cut short (after {len(data)} bytes)")
