"""Read and write disparities: PFM [Middlebury], 16-bit PNG [KITTI] and float TIFF with both bands.

PFM and PNG hold the disparity alone; a TIFF holds disparity and sigma as two float32 bands.
"""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import tifffile

from barsight.core.arrays import Float32
from barsight.core.errors import InputError, OutputError
from barsight.core.files import atomic_path
from barsight.core.reading.bounded_reading import read_bytes
from barsight.core.records.disparity import Disparity
from barsight.core.records.pairs import RectifiedCamera

_KITTI_STEPS = 256
_MAX_BYTES = 1 << 30
_PFM_HEADER = re.compile(rb"^(P[fF])\s+(\d+)\s+(\d+)\s+([-+0-9.eE]+)\s")


def write_disparity(target: Path, disparity: Disparity) -> None:
    """Write to .pfm (float32, bottom row first, inf for no match), .png (16 bits, d * 256, 0 for no match) or
    .tif (float32, bands `disparity_px` and `sigma_px`, NaN for no match). The file is written atomically.

    Raises `OutputError` for another suffix, and for a PNG whose disparities don't fit 16 bits (d < 1/512 or d
    > 255.99 px).
    """
    suffix = target.suffix.lower()
    if suffix == ".pfm":
        data = _pfm_bytes(disparity.disparity_px)
    elif suffix == ".png":
        data = _kitti_bytes(target, disparity.disparity_px)
    elif suffix in (".tif", ".tiff"):
        bands = np.stack([disparity.disparity_px, disparity.sigma_px]).astype(np.float32)
        with atomic_path(target) as temporary:
            tifffile.imwrite(
                temporary,
                bands,
                photometric="minisblack",
                planarconfig="separate",
                metadata={"bands": "disparity_px, sigma_px"},
                compression=None,
            )
        return
    else:
        raise OutputError(
            f"{target}: disparities are written as .pfm, .png or .tif, not {suffix or 'no suffix'}"
        )
    with atomic_path(target) as temporary:
        temporary.write_bytes(data)


def write_calib(target: Path, camera: RectifiedCamera) -> None:
    """Write Middlebury's calib.txt of a rectified pair, in which depth, mm, is baseline * f / (disparity +
    doffs).

    cam0, cam1: px; doffs: cx1 - cx0, px; baseline: mm.
    """
    f, cx, cy, doffs = camera.focal_px, camera.cx_px, camera.cy_px, camera.doffs_px
    lines = [f"cam{k}=[{f!r} 0 {c!r}; 0 {f!r} {cy!r}; 0 0 1]" for k, c in enumerate((cx, cx + doffs))]
    lines += [f"doffs={doffs!r}", f"baseline={1e3 * camera.baseline_m!r}"]
    lines += [f"width={camera.width}", f"height={camera.height}"]
    with atomic_path(target) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_disparity(path: Path) -> Disparity:
    """Read a file written by `write_disparity` or other software; sigma is NaN where the file has none.

    No match becomes NaN: inf and NaN in a PFM or TIFF, 0 in a PNG. Raises `InputError`.
    """
    suffix = path.suffix.lower()
    try:
        if suffix == ".pfm":
            values = _parse_pfm(path, read_bytes(path, _MAX_BYTES, "check the name"))
        elif suffix == ".png":
            values = _parse_kitti(path, read_bytes(path, _MAX_BYTES, "check the name"))
        elif suffix in (".tif", ".tiff"):
            return _read_tiff(path)
        else:
            raise InputError(
                path, f"is not a disparity file ({suffix or 'no suffix'})", "name a .pfm, .png or .tif"
            )
    except (ValueError, OverflowError) as error:
        raise InputError(path, f"can't be read ({error})", "write it again") from None
    return Disparity(values, np.full(values.shape, np.nan, dtype=np.float32))


def _pfm_bytes(values: Float32) -> bytes:
    height, width = values.shape
    stored = np.where(np.isfinite(values), values, np.inf).astype("<f4")
    return f"Pf\n{width} {height}\n-1.0\n".encode() + np.flipud(stored).tobytes()


def _parse_pfm(path: Path, data: bytes) -> Float32:
    header = _PFM_HEADER.match(data)
    if header is None or header[1] != b"Pf":
        raise InputError(path, "is not a one-channel PFM", "write it with a `Pf` header")
    width, height, scale = int(header[2]), int(header[3]), float(header[4])
    body = data[header.end() :]
    if len(body) != 4 * width * height:
        raise InputError(
            path, f"holds {len(body)} bytes, {width}x{height} needs {4 * width * height}", "fetch it again"
        )
    kind = "<f4" if scale < 0 else ">f4"
    values = np.flipud(np.frombuffer(body, dtype=kind).reshape(height, width)).astype(np.float32)
    values[~np.isfinite(values)] = np.nan
    return values


def _kitti_bytes(target: Path, values: Float32) -> bytes:
    known = np.isfinite(values)
    steps = np.rint(np.where(known, values, 0).astype(np.float64) * _KITTI_STEPS)
    if known.any() and (steps[known].min() < 1 or steps[known].max() > 65535):
        low, high = float(values[known].min()), float(values[known].max())
        raise OutputError(
            f"{target}: disparities {low:.2f}...{high:.2f} px don't fit a 16-bit PNG (0.004...255.99); "
            "write a .pfm or .tif"
        )
    encoded, data = cv2.imencode(".png", steps.astype(np.uint16))
    if not encoded:
        raise OutputError(f"{target}: the PNG could not be encoded")
    return bytes(data.tobytes())


def _parse_kitti(path: Path, data: bytes) -> Float32:
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise InputError(path, "is not a 16-bit gray PNG", "KITTI's disparities are d * 256 in 16 bits")
    values: Float32 = (image / _KITTI_STEPS).astype(np.float32)
    values[image == 0] = np.nan
    return values


def _read_tiff(path: Path) -> Disparity:
    try:
        bands = np.asarray(tifffile.imread(path), dtype=np.float32)
    except (tifffile.TiffFileError, ValueError) as error:
        raise InputError(path, f"is not a readable TIFF ({error})", "write it again") from error
    if bands.ndim == 2:
        bands = np.stack([bands, np.full(bands.shape, np.nan, dtype=np.float32)])
    if bands.ndim != 3 or bands.shape[0] != 2:
        raise InputError(path, f"has the shape {bands.shape}", "one or two bands are needed")
    bands[~np.isfinite(bands)] = np.nan
    return Disparity(bands[0], bands[1])
