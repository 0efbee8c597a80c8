"""Settings by their old names: one line that says the new one."""

from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

from barsight.cli.main import run
from barsight.core.errors import ConfigError
from barsight.core.settings.renamed import RENAMED, refuse_old_keys
from barsight.measure_settings import MeasureSettings
from barsight.simulation.settings.recording import SimulationSettings


def names(settings: object) -> set[str]:
    found = set()
    for field in fields(settings):  # type: ignore[arg-type]
        value = getattr(settings, field.name)
        found |= {field.name} | (names(value) if is_dataclass(value) else set())
    return found


def test_no_setting_has_an_old_name() -> None:
    known = names(MeasureSettings()) | names(SimulationSettings())
    assert not known & set(RENAMED)
    assert {"min_shift", "own_ratio", "max_unknown_ratio", "missing_ratio"} <= known & set(RENAMED.values())


def test_an_old_key_is_told_its_new_name() -> None:
    with pytest.raises(ConfigError, match=r"^map\.least_shift is called map\.min_shift now$"):
        refuse_old_keys({"stereo": {"method": "sgbm"}, "map": {"least_shift": 0.1}})
    with pytest.raises(ConfigError, match=r"motion\.odometry\.offset_sigma_px now$"):
        refuse_old_keys({"motion": {"odometry": {"calibration_sigma_px": 0.1}}})
    refuse_old_keys({"map": {"min_shift": 0.1}, "stereo": {"calibration_sigma_px": 0.1}, "preset": "fast"})


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (
            ("--motion.fusion.calibration-sigma-px", "0.2"),
            "--motion.fusion.calibration-sigma-px is called --motion.fusion.offset-prior-px now",
        ),
        (("--map.least-shift", "0.2"), "--map.least-shift is called --map.min-shift now"),
        (
            ("--lift.max-unknown-share=0.2",),
            "--lift.max-unknown-share is called --lift.max-unknown-ratio now",
        ),
        (("--config", "old.toml"), "old.toml: bundles.least_rise_m is called bundles.min_rise_m now"),
    ],
)
def test_an_old_flag_is_told_its_new_name(
    flags: tuple[str, ...], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("old.toml").write_text("[bundles]\nleast_rise_m = 0.05\n")
    assert run(["measure", "recording", "-o", "out", *flags]) == 2
    shown = capsys.readouterr().err
    assert sentence in shown and shown.count("\n") == 1
    assert not Path("out").exists()
