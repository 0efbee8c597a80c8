"""`barsight calibrate yard`: from a CSV of targets to a pose, and one line for what can't be."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from barsight.cli.main import run

HEADER = "name,yard_x,yard_y,yard_z,x,y,z,sigma_m,check\n"
ROWS = (
    "a,10,0,0,0,0,-8,0.003,0\n", "b,16,0,0,6,0,-8,0.003,0\n", "c,10,5,0,0,5,-8,0.003,0\n",
    "d,16,5,1,6,5,-7,0.003,1\n",
)  # fmt: skip


def test_targets_place_the_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "t.csv").write_text(HEADER + "".join(ROWS))
    assert run(["calibrate", "yard", str(tmp_path / "t.csv"), "-o", str(tmp_path / "yard.yaml")]) == 0
    found = yaml.safe_load((tmp_path / "yard.yaml").read_text())
    expected = np.eye(4)
    expected[:3, 3] = (10, 0, 8)
    np.testing.assert_allclose(found["yard_from_world"], expected, atol=1e-9)
    assert np.array(found["covariance"]).shape == (6, 6)
    assert found["points"] == 3
    assert "check d" in " ".join(capsys.readouterr().err.split())
    report = json.loads((tmp_path / "yard.json").read_text())
    assert [row["kind"] for row in report["table"]] == ["target", "target", "target", "check"]
    assert max(abs(np.array([row["off_mm"] for row in report["table"]])).ravel()) < 1e-6
    assert "<h1>Yard calibration</h1>" in (tmp_path / "yard.html").read_text()


@pytest.mark.parametrize(
    ("text", "code", "reason"),
    [
        (HEADER + ROWS[0] + ROWS[1], 5, "2 pairs of points; 3 are the least"),
        (HEADER + ROWS[0] + ROWS[1] + "c,13,0,0,3,0,-8,,\n", 5, "lie on a line"),
        (
            HEADER + "a,0,0,0,6,0,0,,\nb,6,0,0,0,0,0,,\nc,6,5,0,0,5,0,,\nd,0,5,0,6,5,0,,\n",
            5,
            "turned upside down: names are mixed up",
        ),
        (HEADER + ROWS[0] + ROWS[0], 3, "target a is there twice"),
        (HEADER + "".join(ROWS) + ROWS[2].replace("c", "e"), 3, "c and e are surveyed at one place"),
        (HEADER + "".join(ROWS) + "e,12,3,1,6,5.001,-7,,\n", 3, "d and e are measured at one place"),
        (HEADER + "a,10000,0,0,0,0,0,,\nb,0,0,0,1,1,1,,\n", 3, "10000 m apart; give metres"),
        (HEADER + "a,1,5,0,0,0,0,-8,0,0,0,003,0\n", 3, "line 2 has more fields than the header"),
        (HEADER + "".join(ROWS).replace("6,5,-7", "6,5,-7.1"), 5, "d is 100.0 mm off"),
        (HEADER + "".join(ROWS[:3]) + "e,13,2,0,3,2,-8.2,0.003,0\n", 5, "e is 200.0 mm off"),
        (HEADER + "a,1,2,x,0,0,0,,\n", 3, "line 2: a number is missing or is none"),
        (HEADER + "a,1,2\n", 3, "line 2: a number is missing"),
        (HEADER + "a,1,2,3,0,0,0,-1,\n", 3, "line 2: a value is out of range"),
        ("name,x,y,z\n", 3, "has no column yard_x"),
        ("", 3, "has no column name"),
    ],
)
def test_wrong_targets(
    tmp_path: Path, text: str, code: int, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "t.csv").write_text(text)
    assert run(["calibrate", "yard", str(tmp_path / "t.csv"), "-o", str(tmp_path / "yard.yaml")]) == code
    assert reason in capsys.readouterr().err
    assert not (tmp_path / "yard.yaml").exists()


def test_other_mistakes(tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "yard.yaml")
    for arguments, code, reason in (
        (["no.csv", "-o", out], 3, "no such file"),
        (["no", "-o", out], 3, "no such file or folder"),
        (["no.csv", "-o", str(tmp_path / "yard.txt")], 4, "end its name in .yaml or .yml"),
        (["no.csv", "-o", out, "--sigma-m", "0"], 2, "give metres"),
        ([str(data / "kitti_odometry_a"), "-o", out], 5, "no crane encoders"),
        ([str(data / "yard_dev"), "-o", out], 5, "the roll about it can't be seen"),
    ):
        assert run(["calibrate", "yard", *arguments]) == code
        assert reason in capsys.readouterr().err
