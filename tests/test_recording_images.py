"""Torn pictures are refused at any cut; colours and depths become gray as documented."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from barsight.core.records.gray_levels import TornImageError, to_gray
from barsight.recording.image_decoding import PNG_SIGNATURE, check_png, decode_gray
from recording_samples import picture, png


def test_a_whole_png_is_read_unchanged() -> None:
    image = picture(0)
    np.testing.assert_array_equal(decode_gray(png(image)), image)
    assert check_png(png(image)) == (image.shape[1], image.shape[0])


def test_every_cut_of_a_png_is_refused() -> None:
    data = png(picture(0))
    for length in range(len(data)):
        with pytest.raises(TornImageError):
            decode_gray(data[:length])


def test_a_flipped_bit_is_refused() -> None:
    data = bytearray(png(picture(0)))
    for place in (20, 60, len(data) // 2, len(data) - 20):
        data[place] ^= 4
        with pytest.raises(TornImageError):
            decode_gray(bytes(data))
        data[place] ^= 4


def test_a_png_whose_parts_are_whole_but_too_few_is_refused() -> None:
    """A writer that lost a buffer: every checksum is right, half of the pixels are missing."""
    data = png(picture(0))
    header = data[8 + 8 : 8 + 8 + 13]
    start = data.index(b"IDAT")
    (length,) = struct.unpack_from(">I", data, start - 4)
    pixels = data[start + 4 : start + 4 + length // 2]

    def part(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    torn = PNG_SIGNATURE + part(b"IHDR", header) + part(b"IDAT", pixels) + part(b"IEND", b"")
    check_png(torn)
    with pytest.raises(TornImageError):
        decode_gray(torn)
    with pytest.raises(TornImageError, match="without pixels"):
        check_png(PNG_SIGNATURE + part(b"IHDR", header) + part(b"IEND", b""))


def test_a_jpeg_cut_short_is_refused() -> None:
    data = cv2.imencode(".jpg", picture(0))[1].tobytes()
    assert decode_gray(data).shape == picture(0).shape
    for length in (len(data) - 1, len(data) // 2, 20):
        with pytest.raises(TornImageError):
            decode_gray(data[:length])


def test_no_picture_at_all_is_refused() -> None:
    for data in (b"", b"not a picture", bytes(100)):
        with pytest.raises(TornImageError):
            decode_gray(data)


def test_colour_becomes_gray_by_the_documented_weights() -> None:
    colour = np.random.default_rng(2).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    expected = colour @ np.array([0.114, 0.587, 0.299])
    assert np.abs(decode_gray(png(colour)) - expected).max() <= 0.51
    with_alpha = np.dstack([colour, np.full((20, 30), 7, np.uint8)])
    np.testing.assert_array_equal(decode_gray(png(with_alpha)), decode_gray(png(colour)))


def test_sixteen_bits_become_eight_by_a_fixed_scale() -> None:
    values = np.array([[0, 257, 128, 129, 65535, 32896]], dtype=np.uint16)
    np.testing.assert_array_equal(to_gray(values), [[0, 1, 0, 1, 255, 128]])
    np.testing.assert_array_equal(decode_gray(png(values)), to_gray(values))
    np.testing.assert_array_equal(to_gray(picture(0).astype(np.uint16) * 257), picture(0))


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
def test_fewer_bits_in_sixteen_are_refused_and_black_is_not(bits: int) -> None:
    with pytest.raises(TornImageError, match="full 16 bits"):
        to_gray(np.full((4, 4), 2**bits - 1, np.uint16))
    assert not to_gray(np.zeros((4, 4), np.uint16)).any()


def test_a_dark_picture_that_was_scaled_to_sixteen_bits_is_read() -> None:
    """A whole night was refused, frame by frame, although its levels show that they were scaled."""
    rng = np.random.default_rng(0)
    night = np.clip(rng.normal(20, 8, (60, 80)), 0, 60).astype(np.uint8)
    np.testing.assert_array_equal(to_gray(night.astype(np.uint16) * 257), night)
    twelve = np.clip(rng.normal(320, 96, (60, 80)), 0, 1000).astype(np.uint16)
    assert np.abs(to_gray(twelve << 4) - twelve / 16).max() < 1
    fourteen = 16 * twelve // 4 + rng.integers(0, 4, twelve.shape).astype(np.uint16)
    for raw in (twelve, fourteen, 4 * night.astype(np.uint16), 16 * night.astype(np.uint16)):
        with pytest.raises(TornImageError, match="full 16 bits"):
            to_gray(raw)


def test_kinds_that_would_be_misread_are_refused_by_name() -> None:
    image = picture(0)
    white = io.BytesIO()
    tifffile.imwrite(white, 65535 - image.astype(np.uint16) * 257, photometric="miniswhite")
    eight = io.BytesIO()
    tifffile.imwrite(eight, 255 - image, photometric="miniswhite")
    np.testing.assert_array_equal(decode_gray(eight.getvalue()), image)
    cmyk = io.BytesIO()
    Image.fromarray(image).convert("CMYK").save(cmyk, "JPEG")
    height, width = image.shape
    twelve = b"P5 # a camera's\n%d %d\n4095\n" % (width, height) + (image.astype(">u2") * 16).tobytes()
    plain = b"P5\n%d %d\n255\n" % (width, height) + image.tobytes()
    np.testing.assert_array_equal(decode_gray(plain), image)
    for data, said in ((white.getvalue(), "MINISWHITE"), (cmyk.getvalue(), "CMYK"), (twelve, "up to 4095")):
        with pytest.raises(TornImageError, match=said):
            decode_gray(data)


def test_other_pixels_are_refused() -> None:
    with pytest.raises(TornImageError, match="float32"):
        to_gray(np.zeros((4, 4), np.float32))
    with pytest.raises(TornImageError, match="2 channels"):
        to_gray(np.zeros((4, 4, 2), np.uint8))
