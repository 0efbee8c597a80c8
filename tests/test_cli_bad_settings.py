"""Settings that can't be, in files and flags: one line, an exit code, and nothing left behind."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from barsight.cli.main import run
from cli_runs import FAST, measure, refused


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[stereo]\nmethod = 'magic'\n", ("stereo.method is 'magic'; choose sgbm, csca,",)),
        ("[stereo]\nmax_dept_m = 3.0\n", ("no setting stereo.max_dept_m; did you mean max_depth_m?",)),
        ("preset = 'quick'\n", ("preset is 'quick'; choose best or fast",)),
        ("[map]\ncell_m = -1.0\n", ("cell_m",)),
        ("[map\n", ("TOML",)),
        ("\ufeff[map]\ncell_m = 99\n", ("map.cell_m must lie",)),
        ("mp = 1\n", ("there is no setting mp; did you mean map?",)),
    ],
)
def test_bad_configuration(
    recording: Path, capsys: pytest.CaptureFixture[str], text: str, words: tuple[str, ...]
) -> None:
    path = recording.parent / "settings.toml"
    path.write_text(text)
    refused(recording, capsys, "settings.toml", *words, flags=("--config", str(path)))


@pytest.mark.parametrize("flag", ["--fetch", "--lifted"])
def test_a_list_of_bundles_without_any_is_refused(flag: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A script whose variable was empty: all lifts would be offered, or what was lifted forgotten."""
    for arguments in ([flag, "--magnet", "magnet.toml"], ["--magnet", "magnet.toml", flag]):
        assert run(["lifts", "out", *arguments]) == 2
        assert f"{flag} has no value" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--fetch", "-h"], ["--lifted", "--help"], ["--fetch", "3", "-h"]])
def test_a_list_without_any_still_leads_to_the_help(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(["lifts", "out", *arguments])
    assert ended.value.code == 0 and "--magnet" in capsys.readouterr().out


def test_a_command_takes_no_argument_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["store", "list"]) == 3
    assert "there is no such store" in capsys.readouterr().err


def test_impossible_flag(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(recording, capsys, "min_views", flags=("--map.min-views", "0"))


def test_flags_go_before_the_configuration(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording.parent / "settings.toml"
    path.write_text("[map]\nmin_views = 99\n[stereo.sgbm]\nblock_px = 7\n")
    refused(recording, capsys, "99 frames", flags=("--config", str(path)))
    code, _ = measure(recording, capsys, "--config", str(path), "--map.min-views", "2")
    assert code == 0
    assert '"block_px": 7' in (recording.parent / "out" / "result.json").read_text()


def test_unknown_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["mesure"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("group", "line"),
    [
        ("bench", "barsight: bench needs a benchmark: stereo, "),
        ("calibrate", "barsight: calibrate needs a kind: board, stereo, "),
    ],
)
def test_a_group_alone_asks_for_the_rest(group: str, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([group]) == 2
    told = capsys.readouterr()
    assert told.err.startswith(line) and told.err.count("\n") == 1 and not told.out
    assert run([group, "--help"]) == 0
    told = capsys.readouterr()
    assert told.out.startswith(f"usage: barsight {group} KIND ...") and "  stereo " in told.out


@pytest.mark.parametrize(
    ("words", "usage"),
    [
        (("store", "keep"), "URL RECORDING WHY [--release | --no-release] [--by STR]"),
        (("yard",), "[URL]"),
        (("measure",), "RECORDING [...]"),
        (("bench", "length"), "RECORDING"),
    ],
)
def test_help_names_positional_arguments(
    words: tuple[str, ...], usage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        run([*words, "--help"])
    told = capsys.readouterr().out
    assert usage in told.split("\n\n")[0] and "(default: )" not in told.partition(" options ")[0]


def test_descriptions_in_help_flow(capsys: pytest.CaptureFixture[str]) -> None:
    """They kept the source's line breaks inside the terminal's own."""
    with pytest.raises(SystemExit):
        run(["measure", "--help"])
    said = " ".join(capsys.readouterr().out.replace("│", "").split("\n"))
    first = re.search(r"The recording; or several.*?changed\.", said)
    assert first is not None and all(len(gap) < 20 for gap in re.findall(r" {2,}", first[0]))


def test_result_says_what_was_used(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    measure(recording, capsys, "--use", "stereo", "imu")
    result = json.loads((recording.parent / "out" / "result.json").read_text())
    assert result["is_simulated"] is True
    assert result["reference"] == "world"
    assert result["sensors_used"] == ["stereo", "imu"]
    assert result["frames"]["total"] == result["frames"]["used"] == 4
    assert len(result["hashes"]["calibration"]) == 64
    rows = np.loadtxt(recording.parent / "out" / "trajectory.tum")
    assert rows.shape == (4, 8)


def test_names_too_long(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    long = recording.parent / ("a" * 300)
    assert run(["measure", str(long), "-o", str(recording.parent / "out"), *FAST]) == 1
    assert "too long" in capsys.readouterr().err
    assert run(["measure", str(recording), "-o", str(long), *FAST]) == 4
    assert "too long" in capsys.readouterr().err
    named = recording.parent / "long.toml"
    named.write_text(f'recording.rig = "{"a" * 300}.yaml"\n')
    assert run(["measure", str(recording), "-o", str(recording.parent / "out"), "--config", str(named)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    "flags",
    [
        ("--map.profile-y-m", "nan"),
        ("--map.fill-m", "inf"),
        ("--stereo.sgbm.subpixel-sigma-px", "nan"),
        ("--motion.odometry.features", "1000000000"),
        ("--map.min-views", "9" * 20),
        ("--use", "imu"),
    ],
)
def test_settings_that_are_no_numbers(
    recording: Path, capsys: pytest.CaptureFixture[str], flags: tuple[str, ...]
) -> None:
    refused(recording, capsys, flags[0].rpartition(".")[2].lstrip("-").replace("-", "_"), flags=flags)


def test_nothing_sure_enough(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(recording, capsys, "max_depth_m", flags=("--stereo.max-depth-m", "1"))
    refused(recording, capsys, "320 px wide", flags=("--stereo.max-disparity-px", "1000000"))


def test_a_simulation_of_no_number(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["simulate", str(tmp_path / "out"), "--camera.heading-deg", "nan"]) == 2
    assert "camera.heading_deg is nan" in capsys.readouterr().err
    assert run(["simulate", str(tmp_path / "out"), "--camera.rig-seed", "-3"]) == 2
    assert "camera.rig_seed must be at least 0, not -3" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())
