"""Targets picked by hand in the left pictures: found again in the right ones, placed within their sigma."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from barsight.calibration.boards.marker_detection import find_tags
from barsight.cli.main import run
from barsight.core.errors import Failed
from barsight.core.records.pairs import RectifiedPair, StereoFrame
from barsight.recording.open import open_recording
from barsight.registration.picks import find_right, see_picks
from barsight.registration.tags import PlacedTag
from barsight.registration.yard_file import read_yard_file
from test_yard_tags import LAID, PLACES, SHIFT, SURVEY_M, TURN, Way, paper, rendered

__all__ = ["rendered"]
LIST, PICKS = "name,yard_x,yard_y,yard_z,sigma_m,check\n", "name,stamp_ns,u,v\n"
NAMES = tuple(f"post {number}" for number in PLACES)


def test_a_pick_is_found_again_or_said_why_not() -> None:
    way = Way(3)
    (frame,) = way.frames({3: [paper(3, (1.6, 0.1, 0.3))]})
    pair = way.rectifier(frame)
    assert isinstance(pair, RectifiedPair)
    camera, mounting = way.rig.cam0, way.posed[3].reference_from_body @ way.rig.body_from_cam0
    place = mounting.inverse().apply(np.array([[1.6, 0.1, 0.3]]))
    raw = camera.project(place)
    flat = way.rectifier.places(raw, raw)[0][0]
    found = find_right(pair, flat)
    assert not isinstance(found, Failed)
    depth = pair.camera.focal_px * pair.camera.baseline_m / (flat[0] - found[0] + pair.camera.doffs_px)
    assert depth == pytest.approx(place[0, 2], abs=0.02) and abs(found[1] - flat[1]) < 0.3
    for place, code in (((4.0, 200.0), "out-of-sight"), ((500.0, 80.0), "no-match")):
        lost = find_right(pair, np.array(place))
        assert isinstance(lost, Failed) and lost.code == code


def test_picks_are_placed_within_their_sigma() -> None:
    way, rng, chi2 = Way(4), np.random.default_rng(8), []
    everywhere = [paper(number, place) for number, place in PLACES.items()]
    frames = way.frames(dict.fromkeys(range(7), everywhere))
    picks = {frame.stamp_ns: picked(way, frame, rng) for frame in frames}
    seen, lost = see_picks(frames, way.rectifier, way.posed, picks, NAMES, lambda: None)
    assert len(lost) < 4 and seen.name(0) == "target post 3"
    for number, place in enumerate(PLACES.values()):
        found = seen.place(number)
        assert isinstance(found, PlacedTag) and found.pairs >= 3
        off = found.place_m - place
        assert np.linalg.norm(off) < 0.02
        chi2.append(off @ np.linalg.solve(found.covariance_m2, off))
    assert max(chi2) < 16.3


def picked(way: Way, frame: StereoFrame, rng: np.random.Generator) -> dict[int, np.ndarray]:
    """Pick the papers that the left picture shows, 0.7 pixels off."""
    mounting = way.posed[frame.stamp_ns].reference_from_body @ way.rig.body_from_cam0
    numbers, quads = find_tags(frame.left)
    places = [PLACES[int(number)] for number in numbers]
    assert len(quads) == len(places)
    pixels = way.rig.cam0.project(mounting.inverse().apply(np.array(places)))
    order = list(PLACES)
    return {
        order.index(int(number)): pixel + rng.normal(0, 0.7, 2)
        for number, pixel in zip(numbers, pixels, strict=True)
    }


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("tag,stamp_ns,u,v\n", "doesn't begin with name,stamp_ns,u,v"),
        (PICKS + "a,1,2,\n", "line 2: a number is missing or is none"),
        (PICKS + "a,1,2,5,3,5\n", "line 2 has more fields than the header; write numbers with a point"),
        (PICKS + "b,1,2,3\n", "line 2: target b isn't listed; list its surveyed place too"),
        (PICKS + "a,1,2,3\na,1,2,3\n", "line 3: a is picked twice at 1; pick it once"),
        (PICKS + "a,17,2,3\n", "there is no pair with a pose at 17; the nearest is at"),
    ],
)
def test_picks_that_cannot_be_are_refused(
    recording: Path, tmp_path: Path, text: str, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "list.csv").write_text(LIST + "a,0,0,0,,\n")
    (tmp_path / "picks.csv").write_text(text)
    words = ["calibrate", "yard", str(recording), "-o", str(tmp_path / "yard.yaml")]
    listed = ["--tags", str(tmp_path / "list.csv")]
    assert run([*words, *listed, "--picks", str(tmp_path / "picks.csv")]) == 3
    assert reason in " ".join(capsys.readouterr().err.split())
    assert run([*words, "--picks", str(tmp_path / "picks.csv")]) == 2
    assert "--picks needs --tags" in capsys.readouterr().err


@pytest.mark.slow
def test_six_picked_targets_place_the_yard(
    rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    true = LAID @ TURN.T + SHIFT
    surveyed = true + np.random.default_rng(6106).normal(0, SURVEY_M, (6, 3))
    (tmp_path / "list.csv").write_text(LIST + "".join(row(k, place) for k, place in enumerate(surveyed)))
    rng, lines = np.random.default_rng(6107), [PICKS]
    for frame in open_recording(rendered / "recording").frames():
        if isinstance(frame, StereoFrame):
            numbers, quads = find_tags(frame.left)
            for number, quad in zip(numbers, quads, strict=True):
                u, v = quad.mean(axis=0) + rng.normal(0, 0.7, 2)
                lines.append(f"post {number - 3},{frame.stamp_ns},{u:.1f},{v:.1f}\n")
    (tmp_path / "picks.csv").write_text("".join(lines))
    out = tmp_path / "yard.yaml"
    words = ["calibrate", "yard", str(rendered / "recording"), "--tags", str(tmp_path / "list.csv")]
    assert run([*words, "--picks", str(tmp_path / "picks.csv"), "-o", str(out)]) == 0
    told = capsys.readouterr().err
    assert np.linalg.norm(read_yard_file(out).yard_from.apply(LAID) - true, axis=1).max() < 0.012
    checks = [line for line in told.splitlines() if line.startswith("check")]
    assert len(checks) == 2
    for line in checks:
        *off, _, _, sigma = line.split(": off ")[1].split()
        assert np.linalg.norm([float(value) for value in off]) < 2.5 * 3**0.5 * float(sigma)


def row(k: int, place: Sequence[float]) -> str:
    x, y, z = place
    return f"post {k},{x:.5f},{y:.5f},{z:.5f},{SURVEY_M},{int(k > 3)}\n"
