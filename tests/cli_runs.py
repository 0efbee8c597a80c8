"""Runs of the command line on a tiny simulated recording, for the tests of the command line."""

from collections.abc import Callable
from pathlib import Path

import pytest

from barsight.cli.main import run
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.yard import YardSettings

TINY = SimulationSettings(
    length_m=1.5,
    frames=4,
    seed=3,
    camera=CameraSettings(width_px=320, height_px=256, focal_px=312.5),
    yard=YardSettings(max_layers=2),
)
FAST = ("--stereo.method", "sgbm", "--map.cell-m", "0.05")


def measure(recording: Path, capsys: pytest.CaptureFixture[str], *flags: str) -> tuple[int, str]:
    """Exit code and standard error of measuring into a fresh folder beside the recording."""
    out = recording.parent / "out"
    before = sorted(recording.parent.iterdir())
    code = run(["measure", str(recording), "-o", str(out), *FAST, *flags])
    if code:
        left = sorted(path for path in recording.parent.iterdir() if path not in before)
        assert left == [], "a failed run leaves nothing"
    return code, capsys.readouterr().err


def refused(
    recording: Path, capsys: pytest.CaptureFixture[str], *words: str, flags: tuple[str, ...] = ()
) -> str:
    """Measuring fails with one line that holds all the words."""
    code, text = measure(recording, capsys, *flags)
    assert code in (2, 3, 4, 5)
    assert text.count("\n") == 1 and text.startswith("barsight: ")
    for word in words:
        assert word in text
    return text


def edit(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


def pictures(recording: Path, camera: str) -> list[Path]:
    return sorted((recording / "mav0" / camera / "data").glob("*.png"))


def cut_short(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
