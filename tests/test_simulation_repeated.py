"""A recording driven several times: stamps and places go on, pictures are the first lap's."""

from pathlib import Path

import numpy as np
import pytest

from barsight.benchmarks.yard.repeated_recording import repeat
from barsight.core.errors import InputError

START_NS, STEP_NS = 1_700_000_000_000_000_000, 50_000_000


def written(folder: Path) -> Path:
    """21 readings of the encoders, 201 of the IMU, pictures (a word each) at three of the readings."""
    for name in ("cam0", "cam1", "imu0", "crane0"):
        (folder / "mav0" / name).mkdir(parents=True)
        (folder / "mav0" / name / "sensor.yaml").write_text(f"sensor: {name}\n")
    crane = [f"{START_NS + k * STEP_NS},{0.1 * k:.6f},0.500000,8.000000" for k in range(21)]
    (folder / "mav0/crane0/data.csv").write_text("#t,x,y,z\n" + "\n".join(crane) + "\n")
    imu = [f"{START_NS + k * STEP_NS // 10},0,0,0,0,0,{k}" for k in range(201)]
    (folder / "mav0/imu0/data.csv").write_text("#t,w,w,w,a,a,a\n" + "\n".join(imu) + "\n")
    for name in ("cam0", "cam1"):
        (folder / "mav0" / name / "data").mkdir()
        stamps = [START_NS + k * STEP_NS for k in (2, 10, 18)]
        rows = "".join(f"{stamp},{stamp}.png\n" for stamp in stamps)
        (folder / "mav0" / name / "data.csv").write_text("#t,name\n" + rows)
        for stamp in stamps:
            (folder / "mav0" / name / "data" / f"{stamp}.png").write_text(f"{name} {stamp}")
    return folder


def table(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", dtype=str, skiprows=1)


def test_laps_go_on_where_the_crane_stopped(tmp_path: Path) -> None:
    source, target = written(tmp_path / "one"), tmp_path / "three"
    repeat(source, target, 3)
    crane = table(target / "mav0/crane0/data.csv")
    stamps = crane[:, 0].astype(np.int64)
    np.testing.assert_array_equal(np.diff(stamps), STEP_NS)
    assert stamps.size == 63
    x = crane[:, 1].astype(float)
    np.testing.assert_allclose(np.diff(x), np.where(np.arange(62) % 21 == 20, 0.0, 0.1), atol=1e-9)
    imu = table(target / "mav0/imu0/data.csv")
    np.testing.assert_array_equal(imu[201:402, 1:], imu[:201, 1:])
    assert (np.diff(imu[:, 0].astype(np.int64)) > 0).all()
    for name in ("cam0", "cam1"):
        rows = table(target / "mav0" / name / "data.csv")
        assert len(rows) == 9
        lap = stamps[21] - stamps[0]
        for k, (stamp, file) in enumerate(rows):
            first = START_NS + (2, 10, 18)[k % 3] * STEP_NS
            assert int(stamp) == first + k // 3 * lap
            assert (target / "mav0" / name / "data" / file).read_text() == f"{name} {first}"
        assert (target / "mav0" / name / "sensor.yaml").read_text() == f"sensor: {name}\n"


def test_without_encoders_there_is_no_way_to_go_on(tmp_path: Path) -> None:
    source = written(tmp_path / "one")
    (source / "mav0/crane0/data.csv").unlink()
    with pytest.raises(InputError, match="crane0"):
        repeat(source, tmp_path / "three", 3)
    assert not (tmp_path / "three").exists()
