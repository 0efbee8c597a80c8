"""Coded circles in the pictures: none misread, middles to hundredths of a pixel, placed in the yard."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.calibration.boards.ring_detection import (
    PAPER,
    find_rings,
    nearest_disc,
    ring_codes,
    ring_pattern,
)
from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.registration.surveyed_targets import SurveyedTags, read_tags
from barsight.registration.tags import PlacedTag, see_tags
from barsight.registration.yard_file import read_yard_file
from barsight.simulation.simulate import laid_stock
from barsight.simulation.worlds.tags import lay_tags
from test_yard_tags import LAID, SETTINGS, SHIFT, SURVEY_M, TURN, Way, stick

PLACES = {
    3: (0.4, -0.9, 0.1),
    7: (1.6, 0.9, 0.4),
    40: (2.9, -0.8, 0.9),
    61: (2.2, 0.1, 0.0),
    90: (0.6, 1.0, 0.2),
}


def corners_of(middle: Sequence[float], half: float, turn: float, squeeze: float) -> np.ndarray:
    """A square's corners, turned, then squeezed along x as a tilted paper's are."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    c, s = np.cos(turn), np.sin(turn)
    return square @ np.array([[c, s], [-s, c]]) * (squeeze, 1) + middle


def test_drawn_circles_are_found_to_hundredths_of_a_pixel_and_read() -> None:
    rng, found, read, wrong = np.random.default_rng(8101), [], 0, 0
    numbers = rng.permutation(len(ring_codes()))[:40]
    for number in numbers.tolist():
        middle = np.array([80, 80]) + rng.uniform(-0.5, 0.5, 2)
        radius, turn, squeeze = rng.uniform(5, 12), rng.uniform(0, 2 * np.pi), rng.uniform(0.75, 1)
        image = np.full((160, 160), 90.0)
        stick(image, ring_pattern(number), corners_of(middle, PAPER * radius, turn, squeeze))
        noisy = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        told, squares = find_rings(noisy)
        read += told.tolist() == [number]
        wrong += any(one != number for one in told.tolist())
        if told.tolist() == [number]:
            found.append(squares[0].mean(axis=0) - middle)
    assert wrong == 0 and read >= 38
    assert np.sqrt(np.mean(np.square(found))) < 0.05


def test_nothing_else_is_taken_for_one() -> None:
    rng = np.random.default_rng(8102)
    image = cv2.GaussianBlur(rng.integers(0, 255, (512, 640)).astype(np.uint8), (0, 0), 3)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
    for x, y in rng.uniform(20, 480, (60, 2)).astype(int).tolist():
        cv2.circle(image, (x, y), 7, 20, -1)
    assert find_rings(image)[0].size == 0


def test_the_disc_beside_a_place_is_found_dark_or_bright_and_one_that_is_not_round_is_none() -> None:
    y, x = (np.indices((80 * 8, 80 * 8)) + 0.5) / 8 - 0.5
    for dark, bright in ((30, 200), (210, 60)):
        drawn = np.where(np.hypot(x - 38.3, y - 41.6) < 5, dark, bright)
        blotted = np.where((np.abs(x - 32) < 2) & (np.abs(y - 41) < 2), dark, drawn)
        round_one, other = (
            one.reshape(80, 8, 80, 8).mean(axis=(1, 3)).astype(np.uint8) for one in (drawn, blotted)
        )
        found = nearest_disc(round_one, np.array([42.0, 40.0]), 8.0)
        assert found is not None and found == pytest.approx([38.3, 41.6, 5], abs=0.1)
        assert nearest_disc(round_one, np.array([48.0, 40.0]), 8.0) is None
        assert nearest_disc(other, np.array([42.0, 40.0]), 8.0) is None


def test_circles_in_pairs_are_placed_within_their_sigma() -> None:
    way = Way(5)
    everywhere = [(ring_pattern(number), np.array(place)) for number, place in PLACES.items()]
    frames = way.frames(dict.fromkeys(range(7), everywhere))
    seen = see_tags(frames, way.rectifier, way.posed, lambda: None, are_rings=True)
    assert set(seen.sightings) == set(PLACES) and seen.name(3) == "ring 3"
    for number, place in PLACES.items():
        found = seen.place(number)
        assert isinstance(found, PlacedTag) and found.pairs >= 3
        off = found.place_m - place
        assert np.linalg.norm(off) < 0.005
        assert off @ np.linalg.solve(found.covariance_m2, off) < 16.3


def test_a_list_says_that_they_are_circles(tmp_path: Path) -> None:
    path = tmp_path / "rings.csv"
    path.write_text("ring,yard_x,yard_y,yard_z\n5,1,0.2,1.5\n")
    listed = read_tags(path)
    assert listed.are_rings and listed.numbers.tolist() == [5]
    path.write_text("ring,yard_x,yard_y,yard_z\n999,1,0.2,1.5\n")
    with pytest.raises(InputError, match="'999' is no circle coded in 12"):
        read_tags(path)


def test_circles_are_laid_where_the_list_says() -> None:
    rings = SurveyedTags(
        np.array([5]), np.array([[1.0, 0.2, 1.5]]), np.full(1, np.nan), np.zeros(1, bool), are_rings=True
    )
    laid = lay_tags(laid_stock(SETTINGS), rings, 0.1, SETTINGS)
    plate = laid.scene.primitives.shape[-1]
    assert [*plate[:2], plate[2] + plate[14]] == pytest.approx([1.0, 0.2, 1.5])
    assert plate[12:14] == pytest.approx(0.2)
    assert (laid.codes[0] == ring_pattern(5)).all()


@pytest.mark.slow
def test_six_rendered_circles_place_the_yard(tmp_path: Path) -> None:
    def write(name: str, yard: np.ndarray) -> str:
        rows = (
            f"{k + 3},{x:.5f},{y:.5f},{z:.5f},{SURVEY_M},{int(k > 3)}" for k, (x, y, z) in enumerate(yard)
        )
        (tmp_path / name).write_text("\n".join(["ring,yard_x,yard_y,yard_z,sigma_m,check", *rows, ""]))
        return str(tmp_path / name)

    camera = ("--camera.width-px", "640", "--camera.height-px", "512", "--camera.focal-px", "625")
    yard = ("--camera.above-floor-m", "6", "--yard.max-layers", "2", "--yard.bar-length-m", "5")
    words = ("--length", "3.6", "--frames", "12", "--seed", "8201", "--depth-views", "0", *camera, *yard)
    recording, out = str(tmp_path / "recording"), tmp_path / "yard.yaml"
    laid = write("laid.csv", LAID)
    assert run(["simulate", recording, *words, "--tags", laid, "--tag-m", "0.1"]) == 0
    true = LAID @ TURN.T + SHIFT
    listed = write("rings.csv", true + np.random.default_rng(8201).normal(0, SURVEY_M, (6, 3)))
    assert run(["calibrate", "yard", recording, "-o", str(out), "--tags", listed]) == 0
    assert np.linalg.norm(read_yard_file(out).yard_from.apply(LAID) - true, axis=1).max() < 0.004
