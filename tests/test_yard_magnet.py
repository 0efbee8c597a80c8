"""Magnet files: the example is whole, impossible values are one line that names the file."""

from __future__ import annotations

from pathlib import Path

import pytest

import barsight
from barsight.cli.main import run
from barsight.core.errors import BarsightError, ConfigError, InputError
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.magnet import load_magnet

EXAMPLE = (Path(barsight.__file__).parent / "yard" / "lifting" / "example_magnet.toml").read_text(
    encoding="utf-8"
)


def test_the_example_is_assumed_where_no_file_is_given(tmp_path: Path) -> None:
    copy = tmp_path / "magnet.toml"
    copy.write_text(EXAMPLE, encoding="utf-8")
    assert load_magnet(None) == load_magnet(copy)
    assert load_magnet(None).half_span_m == pytest.approx(2.55)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("safety_factor = 2.0", "safety_factor = 1.9", "safety_factor"),
        ("capacity_kg = 8000.0", "capacity_kg = -1.0", "capacity_kg"),
        ("crane_capacity_kg = 12500.0", "crane_capacity_kg = 2000.0", "leaves nothing"),
        ("width_m = 0.1", "width_m = 0.0", "pole"),
        ("\nacross_m = 0.0", "\nacross_m = nan", "across_m"),
        ("gap_m = [0.0, 0.002,", "gap_m = [0.0, 0.006,", "rise"),
        ("kilopascal = [560.0, 470.0", "kilopascal = [560.0, 570.0", "fall"),
        ("30.0, 0.0]", "30.0]", "same length"),
        ("yaw_deg = 0.2", "yaw_deg = 99", "tolerance"),
        ("contact_share = 0.1", "contact_share = 2.0", "contact_share"),
        ("safety_factor = 2.0", "saftey_factor = 2.0", "safety_factor"),
        ("safety_factor = 2.0", "safety_factor = true", "expected float"),
        ("safety_factor = 2.0", "safety_factor = ", "no TOML"),
    ],
)
def test_impossible_magnets_are_one_line(tmp_path: Path, old: str, new: str, word: str) -> None:
    path = tmp_path / "magnet.toml"
    assert old in EXAMPLE
    path.write_text(EXAMPLE.replace(old, new), encoding="utf-8")
    with pytest.raises(BarsightError) as caught:
        load_magnet(path)
    assert isinstance(caught.value, ConfigError | InputError)
    assert word in str(caught.value) and str(path) in str(caught.value)


def test_a_magnet_file_that_is_not_there_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["lifts", str(tmp_path), "--magnet", str(tmp_path / "no.toml")]) == 3
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "no such file" in said and "--magnet" in said


@pytest.mark.parametrize(
    "change", [{"bundles": 0}, {"max_age_s": 0.0}, {"min_confidence": 2.0}, {"max_lean_deg": 0.0}]
)
def test_impossible_lift_settings_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        LiftSettings(**change)  # type: ignore[arg-type]
