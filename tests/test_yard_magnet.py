"""Magnet files: the example is whole, impossible values are one line that names the file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import barsight
from barsight.cli.main import run
from barsight.core.errors import BarsightError, ConfigError, InputError
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.description import load_magnet
from barsight.yard.magnet.pull import Pull, ThinPlate

EXAMPLE = (Path(barsight.__file__).parent / "yard" / "magnet" / "example_magnet.toml").read_text(
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
        ("along_m = 0.7", "along_m = -0.7", "over each other"),
        ("along_m = 0.7", "along_m = 0.1", "two poles, at along_m -0.7 and 0.1, lie over each other"),
        ("gap_m = [0.0, 0.002,", "gap_m = [0.0, 0.006,", "rise"),
        ("kilopascal = [800.0, 710.0", "kilopascal = [800.0, 810.0", "fall"),
        ("170.0, 70.0, 0.0]", "170.0, 0.0]", "same length"),
        ("0.0, 0.002, 0.005, 0.01, 0.02, 0.03, 0.04", "0, 2, 5, 10, 20, 30, 40", "pull gap_m is in m"),
        ("0.0, 0.002, 0.005, 0.01, 0.02, 0.03, 0.04", "0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4", "give gaps in m"),
        ("own_mass_kg = 2600.0", "own_mass_kg = 2.6", "give masses in kg"),
        ("[0.12, 0.34, 0.55, 0.7]", "[0.7, 0.55, 0.34, 0.12]", "round_ratio can't fall"),
        ("gap_m = 0.008", "gap_m = 8.0", "limits gap_m is in m"),
        ("offset_across_m = 0.04", "offset_across_m = 40.0", "in m, at most 20"),
        ("overhang_m = 2.5", "overhang_m = 2500.0", "in m, at most 20"),
        ("length_m = 5.4", "length_m = 5400.0", "longer than 40 m"),
        ("yaw_deg = 0.2", "yaw_deg = 99", "tolerance"),
        ("contact_share = 0.1", "contact_share = 2.0", "contact_share"),
        ("safety_factor = 2.0", "saftey_factor = 2.0", "safety_factor"),
        ("safety_factor = 2.0", "safety_factor = true", "safety_factor is True; give a number"),
        ("safety_factor = 2.0", "safety_factor = ", "not a TOML"),
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


@pytest.mark.parametrize(
    ("drop", "factor"),
    [("", 2.0), ('type = "electro"', 3.0), ("battery_backup = true", None)],
)
def test_the_type_sets_the_least_factor(tmp_path: Path, drop: str, factor: float | None) -> None:
    path = tmp_path / "magnet.toml"
    path.write_text(EXAMPLE.replace(drop, "") if drop else EXAMPLE, encoding="utf-8")
    if factor is not None:
        assert load_magnet(path).needed_factor == factor
        return
    with pytest.raises(ConfigError, match="less than 3, the least of an electro magnet without"):
        load_magnet(path)


def test_an_old_file_is_read_as_the_worst_magnet(tmp_path: Path) -> None:
    begin, end = EXAMPLE.index("thickness_m = 0.05"), EXAMPLE.index("# How far the crane may miss")
    path = tmp_path / "magnet.toml"
    path.write_text(EXAMPLE[:begin] + EXAMPLE[end:], encoding="utf-8")
    old, new = load_magnet(path).pull, load_magnet(None).pull
    for diameter in (0.02, 0.05, 0.1, 0.3):
        assert np.all(old.on_bars(diameter, 0.1)[1] <= new.on_bars(diameter, 0.1)[1] + 1e-9)


def test_a_makers_table_comes_back_within_a_tenth() -> None:
    # A battery magnet of DGUV 209-013: 3000 kg on flat steel, 1500 kg on round; thin plates by their flux.
    gaps = (0.0, 0.001, 0.003, 0.01)
    thick, thin = (400.0, 330.0, 220.0, 0.0), (180.0, 155.0, 115.0, 0.0)
    pull = Pull(gaps, thick, 0.04, (ThinPlate(0.015, thin),), (0.06, 0.2), (0.4, 0.5), 1.0, 1.0, 1.0)
    for thickness, rated in ((0.015, thin), (0.04, thick), (0.1, thick)):
        assert pull.on_plate(thickness, 0.1) == pytest.approx(rated, rel=0.1)
    u = np.linspace(-0.05, 0.05, 2001)
    for diameter, ratio in ((0.06, 0.4), (0.13, 0.45), (0.2, 0.5)):
        inside = np.maximum((diameter / 2) ** 2 - u**2, 0)
        gap = np.where(inside > 0, diameter / 2 - np.sqrt(inside), 1.0)
        likely, low = (np.interp(gap, gaps, curve, right=0).mean() for curve in pull.on_bars(diameter, 0.1))
        assert likely / 400 == pytest.approx(ratio, rel=0.1)
        assert low <= likely + 1e-9


def test_pull_does_not_rise_for_thin_bars() -> None:
    pull = load_magnet(None).pull
    low = [pull.on_bars(diameter, 0.1)[1][0] for diameter in (0.01, 0.02, 0.04, 0.06)]
    assert low == sorted(low) and low[0] < 0.2 * low[-1]


def test_a_magnet_file_that_is_not_there_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["lifts", str(tmp_path), "--magnet", str(tmp_path / "no.toml")]) == 3
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "no such file" in said and "given as magnet" in said


@pytest.mark.parametrize(
    "change",
    [
        {"bundles": 0}, {"max_age_s": 0.0}, {"min_confidence": 2.0}, {"max_lean_deg": 0.0},
        {"stanchions": ((math.nan, 0.0, 1.0),)}, {"stanchions": ((0.0, 0.0, -1.0),)},
        {"no_lift_areas": ((-math.inf, 0.0, 1.0, 1.0),)}, {"no_lift_areas": ((0.0, 0.0, 0.0, 1.0),)},
    ],
)  # fmt: skip
def test_impossible_lift_settings_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        LiftSettings(**change)
