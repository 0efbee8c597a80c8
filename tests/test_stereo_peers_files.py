"""Disparity files: what is written is read back, others' files are understood, torn ones are refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.core.errors import InputError, OutputError
from barsight.core.records.disparity import Disparity
from barsight.stereo.disparity_files import read_disparity, write_disparity


def _example() -> Disparity:
    rng = np.random.default_rng(0)
    values = rng.uniform(1, 200, (7, 11)).astype(np.float32)
    values[2, 3] = np.nan
    sigma = np.where(np.isnan(values), np.nan, 0.25).astype(np.float32)
    return Disparity(values, sigma)


@pytest.mark.parametrize(("suffix", "tolerance"), [(".pfm", 0), (".png", 1 / 512), (".tif", 0)])
def test_a_disparity_comes_back(tmp_path: Path, suffix: str, tolerance: float) -> None:
    example = _example()
    write_disparity(tmp_path / f"d{suffix}", example)
    found = read_disparity(tmp_path / f"d{suffix}")
    assert found.disparity_px.dtype == np.float32
    assert (np.isnan(found.disparity_px) == np.isnan(example.disparity_px)).all()
    assert np.nanmax(np.abs(found.disparity_px - example.disparity_px)) <= tolerance
    if suffix == ".tif":
        np.testing.assert_array_equal(found.sigma_px, example.sigma_px)
    else:
        assert np.isnan(found.sigma_px).all()
    assert [path.name for path in tmp_path.iterdir()] == [f"d{suffix}"]


def test_opencv_reads_our_pfm_the_right_way_up_and_we_read_big_endian(tmp_path: Path) -> None:
    example = _example()
    write_disparity(tmp_path / "d.pfm", example)
    theirs = cv2.imread(str(tmp_path / "d.pfm"), cv2.IMREAD_UNCHANGED)
    known = np.isfinite(example.disparity_px)
    np.testing.assert_array_equal(theirs[known], example.disparity_px[known])
    assert np.isinf(theirs[~known]).all()
    big = b"Pf\n11 7\n1.0\n" + np.flipud(example.disparity_px).astype(">f4").tobytes()
    (tmp_path / "big.pfm").write_bytes(big)
    np.testing.assert_array_equal(read_disparity(tmp_path / "big.pfm").disparity_px, example.disparity_px)


def test_torn_and_foreign_files_are_refused(tmp_path: Path) -> None:
    write_disparity(tmp_path / "d.pfm", _example())
    (tmp_path / "cut.pfm").write_bytes((tmp_path / "d.pfm").read_bytes()[:-4])
    (tmp_path / "colour.pfm").write_bytes(b"PF\n1 1\n-1.0\n" + bytes(12))
    assert cv2.imwrite(str(tmp_path / "gray8.png"), np.zeros((4, 4), np.uint8))
    (tmp_path / "no.tif").write_bytes(b"not a tiff")
    for name in ("cut.pfm", "colour.pfm", "gray8.png", "no.tif", "absent.pfm", "d.txt"):
        with pytest.raises(InputError, match=name):
            read_disparity(tmp_path / name)


def test_what_a_format_cant_hold_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    negative = Disparity(np.full((3, 3), -4, np.float32), np.full((3, 3), 1, np.float32))
    with pytest.raises(OutputError, match="16-bit PNG"):
        write_disparity(tmp_path / "d.png", negative)
    with pytest.raises(OutputError, match=r"\.pfm, \.png or \.tif"):
        write_disparity(tmp_path / "d.jpg", negative)
    assert not list(tmp_path.iterdir())
