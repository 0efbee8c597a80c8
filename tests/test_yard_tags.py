"""Tags in the pictures place the yard: drawn pairs at known poses, and a rendered recording end to end."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.marker_detection import fit_tag, tag_pattern
from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.geometry.rig import StereoRig
from barsight.cli.main import run
from barsight.core.errors import ConfigError, Failed
from barsight.core.pose import Pose
from barsight.core.records.pairs import StereoFrame
from barsight.core.records.trajectory import PosedFrame
from barsight.recording.open import open_recording
from barsight.registration.rigid import align_rigid
from barsight.registration.surveyed_targets import SurveyedTags
from barsight.registration.tags import (
    PlacedTag,
    SeenTags,
    is_mirrored,
    other_family,
    see_tags,
    turned_covariance,
)
from barsight.registration.yard_file import read_yard_file
from barsight.simulation.optics import mount_rig
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.simulate import laid_stock
from barsight.simulation.worlds.tags import lay_tags
from barsight.yard_frame import calibration_id, in_yard

SETTINGS = SimulationSettings(camera=CameraSettings(width_px=640, height_px=512, focal_px=625))
SIDE_M = 0.3
HEADER = "tag,yard_x,yard_y,yard_z,sigma_m,check\n"


def stick(image: np.ndarray, pattern: np.ndarray, corners_px: np.ndarray) -> None:
    """Draw paper over a picture by the homography of its corners, 8 x 8 samples a pixel, then blurred."""
    fine = 8
    low, high = (
        np.floor(corners_px.min(axis=0)).astype(int) - 3,
        np.ceil(corners_px.max(axis=0)).astype(int) + 4,
    )
    size = tuple(int(v) for v in fine * (high - low))
    n = len(pattern)
    cell = 16 if n < 20 else 4
    large = np.kron(pattern, np.ones((cell, cell), np.uint8))
    source = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32) * cell - 0.5
    target = (fine * (corners_px - low + 0.5) - 0.5).astype(np.float32)
    turn = cv2.getPerspectiveTransform(source, target)
    drawn = cv2.warpPerspective(large, turn, size, flags=cv2.INTER_LINEAR).astype(np.float32)
    inside = cv2.warpPerspective(np.full_like(large, 255), turn, size).astype(np.float32) / 255
    rows, columns = slice(low[1], high[1]), slice(low[0], high[0])
    under = np.kron(image[rows, columns], np.ones((fine, fine))).astype(np.float32)
    mixed = cv2.GaussianBlur(inside * (20 + 0.6 * drawn) + (1 - inside) * under, (0, 0), 0.45 * fine)
    image[rows, columns] = mixed.reshape(high[1] - low[1], fine, high[0] - low[0], fine).mean(axis=(1, 3))


def drawn_frame(
    rig: StereoRig, posed: PosedFrame, tags: Sequence[tuple[np.ndarray, np.ndarray]], rng: np.random.Generator
) -> StereoFrame:
    """A pair that shows papers (pattern, middle (3,)), face up, over noise of two gray levels."""
    pictures = []
    for camera, mounting in ((rig.cam0, rig.body_from_cam0), (rig.cam1, rig.body_from_cam1)):
        image = np.full((camera.height, camera.width), 90.0)
        for pattern, middle in tags:
            half = SIDE_M / 16 * min(len(pattern), 10)
            c, s = half * np.cos(middle[0]), half * np.sin(middle[0])
            corners = middle + np.array(
                [[-c - s, c - s, 0], [c - s, c + s, 0], [c + s, s - c, 0], [s - c, -c - s, 0]]
            )
            here = (posed.reference_from_body @ mounting).inverse().apply(np.vstack([corners, middle]))
            projected = camera.project(here)
            pixels, exact = projected[:4], projected[4]
            if len(pattern) > 10:  # a circle is known by its middle, which the lens moves against the corners
                pixels = pixels + exact - np.mean(pixels, axis=0)
            if (pixels > 8).all() and (pixels < np.array([camera.width, camera.height]) - 9).all():
                stick(image, pattern, pixels)
        pictures.append(np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
    return StereoFrame(posed.stamp_ns, *pictures)


PLACES = {
    3: (0.4, -0.9, 0.1), 7: (1.6, 0.9, 0.4), 500: (2.9, -0.8, 0.9), 586: (2.2, 0.1, 0.0), 41: (0.6, 1.0, 0.2),
}  # fmt: skip


class Way:
    """A rig that looks down from 5 m and travels along X, and what it sees of tags."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        mounted = mount_rig(SETTINGS, self.rng)
        self.rig, self.rectifier = mounted.rig, Rectifier(mounted.rig)
        hangs, covariance = mounted.nominal_yard_from_body, np.diag([1e-10] * 3 + [1e-8] * 3)
        self.posed = {
            stamp: PosedFrame(stamp, Pose("yard", "body", hangs, np.array([stamp / 2, 0.0, 5.0])), covariance)
            for stamp in range(7)
        }

    def frames(self, papers: dict[int, list[tuple[np.ndarray, np.ndarray]]]) -> list[StereoFrame]:
        """Draw pairs; papers: what lies there, by stamp."""
        return [drawn_frame(self.rig, self.posed[stamp], papers[stamp], self.rng) for stamp in papers]

    def see(self, papers: dict[int, list[tuple[np.ndarray, np.ndarray]]]) -> SeenTags:
        """Find the tags of such pairs."""
        return see_tags(self.frames(papers), self.rectifier, self.posed, lambda: None)


def paper(number: int, place: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    return tag_pattern(number), np.array(place)


def test_a_fitted_tag_is_known_to_hundredths_of_a_pixel() -> None:
    rng, off = np.random.default_rng(2), []
    for number in range(0, 580, 30):
        image = np.full((80, 90), 70.0)
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
        turn = Rotation.from_euler("z", rng.uniform(0, 360), degrees=True).as_matrix()[:2, :2]
        middle = np.array([44, 40]) + rng.uniform(-2, 2, 2)
        stick(image, tag_pattern(number), 15 * square @ turn.T + middle)
        noisy = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        rough = 12 * square @ turn.T + middle + rng.uniform(-0.7, 0.7, (4, 2))
        found = fit_tag(noisy, number, rough)
        assert found is not None
        off.append(found - 12 * square @ turn.T - middle)
    assert np.sqrt((np.mean(off, axis=1) ** 2).mean()) < 0.02
    assert np.sqrt((np.array(off) ** 2).mean()) < 0.06
    assert fit_tag(np.full((80, 90), 70, np.uint8), 3, 12 * square + 40) is None


def test_tags_in_pairs_are_placed_within_their_sigma() -> None:
    way = Way()
    everywhere = [paper(number, place) for number, place in PLACES.items()]
    seen = way.see(dict.fromkeys(range(7), everywhere))
    assert set(seen.sightings) == set(PLACES) and 0.01 < seen.sigma_px < 0.06
    for number, place in PLACES.items():
        found = seen.place(number)
        assert isinstance(found, PlacedTag) and found.pairs >= 4
        off = found.place_m - place
        assert np.linalg.norm(off) < 0.004
        assert off @ np.linalg.solve(found.covariance_m2, off) < 16.3


def test_a_stray_pair_is_left_out_and_few_are_told() -> None:
    way = Way()
    papers = {stamp: [paper(3, (1.0, 0.2, 0.3))] for stamp in range(5)}
    papers[2] = [paper(3, (1.06, 0.2, 0.3))]
    papers[0].append(paper(9, (0.2, -0.8, 0.3)))
    seen = way.see(papers)
    found = seen.place(3)
    assert isinstance(found, PlacedTag) and found.left_out == 1
    assert np.linalg.norm(found.place_m - (1.0, 0.2, 0.3)) < 0.005
    for number, told in (
        (9, "tag 9 is seen in 1 pair only, 2 are the least"),
        (8, "tag 8 is seen in no pair"),
    ):
        lost = seen.place(number)
        assert isinstance(lost, Failed) and lost.code == "few-pairs" and told in lost.reason


def test_a_number_that_is_there_twice_is_ambiguous() -> None:
    way = Way()
    together = way.see(
        {stamp: [paper(3, (0.8, 0.9, 0.3)), paper(3, (1.0, -0.9, 0.3))] for stamp in range(1, 4)}
    )
    apart = way.see({stamp: [paper(3, (0.8, 0.9 if stamp % 2 else -0.9, 0.3))] for stamp in range(4)})
    for seen in (together, apart):
        lost = seen.place(3)
        assert isinstance(lost, Failed) and lost.code == "ambiguous" and "there twice" in lost.reason


def test_another_family_is_named() -> None:
    way = Way()
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_25h9)
    foreign = np.pad(np.asarray(cv2.aruco.generateImageMarker(family, 4, 7)), 1, constant_values=255)
    papers = {stamp: [(foreign, np.array([1.0, 0.2, 0.3]))] for stamp in range(1, 4)}
    assert way.see(papers).sightings == {}
    assert other_family(way.frames(papers)) == "25h9"
    assert other_family(way.frames({1: [], 2: [], 3: []})) is None


@pytest.mark.parametrize("relief_m", [0.0, 1.0])
def test_a_mirrored_list_is_told(relief_m: float) -> None:
    rng = np.random.default_rng(4)
    places = rng.uniform((0, -2, 0), (8, 2, relief_m), (6, 3))
    tags = tuple(
        PlacedTag(k, place, 1e-6 * np.eye(3), 3, 0, 30.0, place + np.array([0.3, 0, 5]))
        for k, place in enumerate(places)
    )
    turned = places @ Rotation.from_euler("z", 40, degrees=True).as_matrix().T + (100, 20, 0)
    for yard, mirrored in ((turned, False), (turned[:, [1, 0, 2]], True)):
        found = align_rigid(
            places, yard, ("yard", "encoders"), turned_covariance(tags, yard, np.full(6, 1e-3))
        )
        assert not isinstance(found, Failed)
        assert is_mirrored(tags, yard, found) is mirrored


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("name,yard_x,yard_y,yard_z\n", "has no column tag"),
        (HEADER + "587,0,0,0,,\n", "'587' is no tag of the family 36h11; give the number on it, 0 to 586"),
        (HEADER + "a,0,0,0,,\n", "'a' is no tag of the family 36h11"),
        (HEADER + "4,0,0,0,,\n04,1,0,0,,\n", "tag 4 is there twice; give each tag once"),
        (HEADER + "4,0,0,,,\n", "line 2: a number is missing or is none"),
        (HEADER + "4,0,0,0,-1,\n", "line 2: a value is out of range"),
    ],
)
def test_a_list_that_cannot_be_is_refused(
    tmp_path: Path, text: str, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tags.csv").write_text(text)
    words = ["calibrate", "yard", str(tmp_path), "--tags", str(tmp_path / "tags.csv")]
    assert run([*words, "-o", str(tmp_path / "yard.yaml")]) == 3
    assert reason in capsys.readouterr().err


def test_a_recording_without_tags_and_other_mistakes(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tags.csv").write_text(HEADER + "".join(f"{k},{k},{k % 2},0,,\n" for k in range(4)))
    words = ["calibrate", "yard", str(recording), "-o", str(tmp_path / "yard.yaml")]
    words += ["--tags", str(tmp_path / "tags.csv")]
    assert run(words) == 5
    assert "0 of 4 listed tags were placed, 3 besides checks are the least: no tag of the family 36h11" in (
        capsys.readouterr().err
    )
    for more in (["--frame", "body"], ["--measured", str(tmp_path)]):
        assert run([*words, *more]) == 2
        assert "--tags takes a recording, and says the frame" in capsys.readouterr().err
    assert not (tmp_path / "yard.yaml").exists()


def test_tags_are_laid_where_the_list_says_or_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tags = SurveyedTags(np.array([5]), np.array([[1.0, 0.2, 1.5]]), np.full(1, np.nan), np.zeros(1, bool))
    laid = laid_stock(SETTINGS)
    there = lay_tags(laid, tags, 0.24, SETTINGS)
    plate = there.scene.primitives.shape[-1]
    assert [*plate[:2], plate[2] + plate[14]] == pytest.approx([1.0, 0.2, 1.5])
    assert plate[12:14] == pytest.approx(0.15)
    assert there.truth["tags.json"] == [{"tag": 5, "center": [1.0, 0.2, 1.5], "side_m": 0.24}]
    with pytest.raises(ConfigError, match="takes no labels"):
        lay_tags(there, tags, 0.24, SETTINGS)
    low = SurveyedTags(tags.numbers, np.zeros((1, 3)), tags.sigma_m, tags.checks)
    with pytest.raises(ConfigError, match=r"tag 5 must lie 0\.002 m or more over the floor"):
        lay_tags(laid, low, 0.24, SETTINGS)
    for flags, told in ((["--draw", "3"], "no drawn world"), (["--tag-m", "0"], "between 0.01 and 2")):
        assert run(["simulate", str(tmp_path / "out"), "--tags", str(tmp_path / "no.csv"), *flags]) == 2
        assert told in capsys.readouterr().err


TURN, SHIFT = Rotation.from_rotvec([0.002, -0.001, 0.4]).as_matrix(), np.array([100.0, 20.0, 0.05])
LAID = np.array([
    (0.3, -1.2, 0.9), (1.8, 1.3, 1.0), (3.4, -1.0, 0.95), (0.6, 1.5, 1.2), (2.4, -0.2, 1.1), (3.1, 1.2, 1.3),
])  # fmt: skip
SURVEY_M = 0.001


def write_list(path: Path, yard: np.ndarray, numbers: Sequence[int] = range(3, 9)) -> Path:
    """The last two are checks."""
    rows = (
        f"{number},{x:.5f},{y:.5f},{z:.5f},{SURVEY_M},{int(k > 3)}"
        for k, (number, (x, y, z)) in enumerate(zip(numbers, yard, strict=True))
    )
    path.write_text(HEADER + "\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A yard of 3.6 m with six tags of 0.3 m, seen from 5 m with 125 pixels a metre."""
    folder = tmp_path_factory.mktemp("tags")
    write_list(folder / "laid.csv", LAID)
    camera = ("--camera.width-px", "640", "--camera.height-px", "512", "--camera.focal-px", "625")
    yard = ("--camera.above-floor-m", "6", "--yard.max-layers", "2", "--yard.bar-length-m", "5")
    words = ("--length", "3.6", "--frames", "12", "--seed", "6105", "--depth-views", "0", *camera, *yard)
    assert run(["simulate", str(folder / "recording"), *words, "--tags", str(folder / "laid.csv")]) == 0
    return folder


@pytest.mark.slow
def test_six_rendered_tags_place_check_points_within_5_mm_and_inside_sigma(
    rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    true = LAID @ TURN.T + SHIFT
    surveyed = true + np.random.default_rng(6105).normal(0, SURVEY_M, (6, 3))
    listed = write_list(tmp_path / "tags.csv", surveyed)
    out = tmp_path / "yard.yaml"
    words = ["calibrate", "yard", str(rendered / "recording"), "-o", str(out), "--tags"]
    assert run([*words, str(listed)]) == 0
    told = capsys.readouterr().err
    frame, recording = read_yard_file(out), open_recording(rendered / "recording")
    assert frame.yard_from.source == "encoders" and frame.doubts == ()
    assert frame.calibration_id == calibration_id(recording.rig)
    assert np.linalg.norm(frame.yard_from.apply(LAID) - true, axis=1).max() < 0.004
    assert in_yard(recording, out).crane() is not None
    checks = [line for line in told.splitlines() if line.startswith("check")]
    assert [line.split(":")[0] for line in checks] == ["check  tag 7", "check  tag 8"]
    for line in checks:
        *off, _, _, sigma = line.split(": off ")[1].split()
        length = np.linalg.norm([float(value) for value in off])
        assert length < 5 and length < 2 * 3**0.5 * float(sigma)
    write_list(listed, surveyed[:, [1, 0, 2]])
    assert run([*words, str(listed)]) == 5
    assert "mirrored; are yard_x and yard_y swapped?" in capsys.readouterr().err
    write_list(listed, surveyed, (3, 4, 5, 6, 77, 8))
    assert run([*words, str(listed)]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert "tag 77 is seen in no pair, 2 are the least: left out" in told and "tag 7; left out" in told
