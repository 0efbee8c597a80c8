"""The house: a package imports only from floors below its own."""

import ast
from pathlib import Path

import pytest

import barsight

FLOORS = {
    "core": 0,
    "calibration": 1,
    "recording": 2, "stereo": 2, "features": 2, "inertial": 2, "registration": 2,
    "motion": 3,
    "mapping": 4,
    "yard": 5,
    "measurement": 6, "evaluation": 6, "result_folder": 6, "checkpoint": 6, "board_views": 6,
    "report": 7, "pipeline": 7, "simulation": 7, "plant": 7, "viewer": 7,
    "result": 8, "pair_matching": 8, "measure_folder": 8,
    "api": 9, "session": 9,
    "cli": 10,
}  # fmt: skip
ROOT = Path(barsight.__file__).parent
OPTIONAL_ONCE = ("viser", "plotly", "rosbags")


def imported_modules(tree: ast.AST) -> list[str]:
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the floor"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def violations(package: str, source: str) -> list[str]:
    wrong = []
    for name in imported_modules(ast.parse(source)):
        parts = name.split(".")
        if parts[0] != "barsight" or len(parts) < 2 or parts[1] not in FLOORS:
            continue
        if parts[1] != package and FLOORS[parts[1]] >= FLOORS[package]:
            wrong.append(name)
    return wrong


SOURCES = sorted(path for path in ROOT.rglob("*.py") if path.parent != ROOT or path.stem[0] != "_")


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0].removesuffix(".py")
    assert package in FLOORS, f"{package} has no floor"
    assert violations(package, path.read_text(encoding="utf-8")) == []


def test_an_import_that_points_up_is_found() -> None:
    assert violations("stereo", "from barsight.motion import crane") == ["barsight.motion.crane"]
    assert violations("stereo", "import barsight.recording.base") == ["barsight.recording.base"]
    assert violations("motion", "from barsight.stereo import sgbm") == []
