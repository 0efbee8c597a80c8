"""Scores against hand-made truth, loading of scenes, and the tables of `bench stereo`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.benchmarks.stereo.middlebury import bench_stereo, scene_table, stereo_table
from barsight.benchmarks.stereo.middlebury_scenes import load_scene, load_scenes
from barsight.benchmarks.stereo.scores import score_disparity
from barsight.benchmarks.stereo.speed import bench_speed, speed_table, time_chain
from barsight.core.errors import InputError
from barsight.core.json_values import write_json
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.stereo.direct.pipeline import BarsightStereo
from barsight.stereo.disparity_files import write_disparity
from cli_runs import edit


def _disparity(values: np.ndarray, sigma: float = 1.0) -> Disparity:
    values = np.asarray(values, dtype=np.float32)
    sigmas = np.where(np.isfinite(values), np.float32(sigma), np.float32(np.nan)).astype(np.float32)
    return Disparity(values, sigmas)


def test_missing_pixels_count_as_bad_and_unknown_truth_does_not_count() -> None:
    truth = np.array([[10, 10, 10, 10, np.nan]], dtype=np.float32)
    found = _disparity([[10.4, 10.6, 12.5, np.nan, 3]])
    counted = np.array([[True, True, False, True, True]])
    score = score_disparity(found, truth, counted)
    assert (score.bad05_pct, score.bad1_pct, score.bad2_pct) == (75, 50, 50)
    assert score.counted_bad05_pct == pytest.approx(200 / 3)
    assert score.counted_bad1_pct == score.counted_bad2_pct == pytest.approx(100 / 3)
    assert score.coverage_pct == 75 and score.counted_coverage_pct == pytest.approx(200 / 3)
    assert score.average_px == pytest.approx((0.4 + 0.6 + 2.5) / 3, abs=1e-6)
    assert score.median_px == pytest.approx(0.6, abs=1e-6)
    assert (score.within1_pct, score.within2_pct) == (100, 100)


def test_shares_within_sigma_of_a_gaussian_error_are_those_of_a_gaussian() -> None:
    rng = np.random.default_rng(1)
    truth = np.full((200, 200), 20, dtype=np.float32)
    score = score_disparity(_disparity(truth + rng.normal(0, 0.3, truth.shape), 0.3), truth, truth > 0)
    assert score.within1_pct == pytest.approx(68.27, abs=1)
    assert score.within2_pct == pytest.approx(95.45, abs=0.5)


def _write_scene(folder: Path, truth: np.ndarray, bits: int = 8) -> None:
    folder.mkdir(parents=True)
    rng = np.random.default_rng(2)
    wide = rng.integers(0, 256, (truth.shape[0], truth.shape[1] + 8)).astype(np.uint8)
    left, right = wide[:, 8:], wide[:, : truth.shape[1]]
    scale = 257 if bits == 16 else 1
    for name, image in (("left", left), ("right", right)):
        stored = image.astype(np.uint16) * scale if bits == 16 else image
        assert cv2.imwrite(str(folder / f"{name}.png"), stored)
    write_disparity(folder / "disp.pfm", _disparity(truth))


def test_a_scene_is_loaded_from_8_and_16_bits_alike(tmp_path: Path) -> None:
    truth = np.full((20, 60), 8, dtype=np.float32)
    truth[0, 0] = np.nan
    _write_scene(tmp_path / "a", truth)
    _write_scene(tmp_path / "b", truth, bits=16)
    first, second = load_scenes(tmp_path)
    assert (first.pair.left == second.pair.left).all() and (first.pair.right == second.pair.right).all()
    assert first.candidates == DisparityRange(0, 16)
    assert np.isnan(first.truth_px[0, 0]) and first.mask == "known"
    assert (first.counted == np.isfinite(first.truth_px)).all()


def test_nonocc_png_is_used_where_there_is_one(tmp_path: Path) -> None:
    truth = np.full((20, 60), 8, dtype=np.float32)
    _write_scene(tmp_path / "a", truth)
    mask = np.zeros((20, 60), dtype=np.uint8)
    mask[:, 30:] = 255
    assert cv2.imwrite(str(tmp_path / "a" / "nonocc.png"), mask)
    scene = load_scene(tmp_path / "a")
    assert (scene.counted == (mask == 255)).all() and scene.mask == "nonocc.png"


def test_a_missing_folder_and_a_torn_scene_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a folder"):
        load_scenes(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no scene"):
        load_scenes(tmp_path)
    _write_scene(tmp_path / "a", np.full((20, 60), 8, dtype=np.float32))
    (tmp_path / "a" / "right.png").unlink()
    with pytest.raises(InputError, match=r"right\.png"):
        load_scenes(tmp_path)


def test_the_bench_prints_tables_and_writes_json(tmp_path: Path) -> None:
    truth = np.full((20, 60), 8, dtype=np.float32)
    _write_scene(tmp_path / "data" / "a", truth)
    _write_scene(tmp_path / "data" / "b", truth + 2)

    def constant(pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        assert candidates.count == 16
        return _disparity(np.full(pair.left.shape, 8.0))

    bench = bench_stereo(tmp_path / "data", {"constant": constant})
    (result,) = bench.methods
    assert [scene.score.bad1_pct for scene in result.scenes] == [0, 100]
    assert result.mean.bad1_pct == 50 and result.mean.average_px == pytest.approx(1)
    assert [scene.mask for scene in result.scenes] == ["known", "known"]
    assert result.per_megapixel.repeats == 5
    assert (
        result.per_megapixel.fastest_ms <= result.per_megapixel.median_ms <= result.per_megapixel.slowest_ms
    )
    assert stereo_table(bench).row_count == 1 and scene_table(bench).row_count == 2
    write_json(tmp_path / "out.json", bench)
    stored = json.loads((tmp_path / "out.json").read_text())
    assert stored["methods"][0]["mean"]["bad1_pct"] == 50
    assert stored["provenance"]["commit"] and stored["provenance"]["cores"] >= 1


def test_bench_speed_times_methods_against_sgbm(tmp_path: Path) -> None:
    def instant(pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        assert pair.left.shape == (1024, 1280) and candidates.count == 96
        return _disparity(np.zeros((1, 1)))

    bench = bench_speed({"instant": instant}, repeats=5)
    assert bench.reference.median_ms > 20 and bench.reference.repeats == 5
    assert bench.methods[0].ratio < 0.1
    assert bench.reference_error_px < 0.3 and 20 < bench.methods[0].median_error_px < 80
    assert speed_table(bench).row_count == 2
    write_json(tmp_path / "out.json", bench)
    assert json.loads((tmp_path / "out.json").read_text())["methods"][0]["method"] == "instant"


def test_all_pairs_of_a_chain_but_the_first_are_timed_as_predicted(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    confirmed: list[int] = []
    confirm = BarsightStereo.confirm

    def counted(
        self: BarsightStereo, pair: RectifiedPair, candidates: DisparityRange, predicted: np.ndarray
    ) -> Disparity:
        confirmed.append(pair.stamp_ns)
        return confirm(self, pair, candidates, predicted)

    monkeypatch.setattr(BarsightStereo, "confirm", counted)
    sgbm, narrow, first, predicted = time_chain(recording, repeats=2)
    assert len(set(confirmed)) == 3 and len(confirmed) == 3 * (1 + 2), "four pairs, three rounds"
    assert (first.time.repeats, predicted.time.repeats, sgbm.time.repeats) == (2, 6, 8)
    assert sgbm.ratio == sgbm.cpu_ratio == 1
    assert all(result.ratio > 0 and result.cpu_ratio > 0 for result in (narrow, first, predicted))
    assert "320x256: SGBM, 96 candidates" in sgbm.method and "320x256: SGBM" in narrow.method


@pytest.mark.parametrize("left", ["none", "late"])
def test_a_chain_that_encoders_do_not_predict_is_refused(recording: Path, left: str) -> None:
    crane = recording / "mav0" / "crane0"
    if left == "none":
        shutil.rmtree(crane)
    else:
        edit(crane / "data.csv", lambda lines: [lines[0], *lines[len(lines) // 2 :]])
    with pytest.raises(InputError, match="lacks encoders"):
        time_chain(recording)
