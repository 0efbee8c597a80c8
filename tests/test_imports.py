"""The house: a package imports only from floors below its own, a room only from rooms before it."""

import ast
from functools import cache
from pathlib import Path

import pytest

import barsight

FLOORS = {
    "core": 0,
    "calibration": 1, "artefacts": 1,
    "recording": 2, "sensors": 2, "stereo": 2, "features": 2, "inertial": 2, "registration": 2,
    "motion": 3,
    "mapping": 4,
    "yard": 5,
    "measurement": 6, "result_folder": 6, "simulation": 6, "board_views": 6, "measure_settings": 6,
    "store": 7, "evaluation": 7, "yard_frame": 7,
    "labels": 8,
    "reconstruction": 9, "bundle_pictures": 9,
    "report": 10, "pipeline": 10, "benchmarks": 10, "viewer": 10,
    "result": 11, "page": 11, "measure_folder": 11,
    "api": 12, "session": 12, "live": 12, "plant": 12, "paper": 12, "acceptance": 12,
    "fleet": 13,
    "cli": 14,
}  # fmt: skip
ROOMS = {
    "calibration": ("geometry", "boards", "files", "stereo", "camera_imu"),
    "recording": (".", "formats", "writers", "open"),
    "stereo": (".", "direct.kernels", "direct.semiglobal", "direct", "baselines", "settings"),
    "motion": (
        ".", "crane", "frontend", "frame_to_frame", "linear", "problem", "batch", "fixed_lag", "rig_check",
        "settings",
    ),
    "core": ("compiling", ".", "records", "reading", "linalg", "settings"),
    "mapping": (".", "surface", "election", "passes"),
    "yard": (
        ".", "bundles.fitting", "bundles.section", "bundles", "stability", "magnet", "placement", "lifting",
        "inventory",
    ),
    "report": (".", "calibration", "files"),
    "page": (".", "api"),
    "simulation": ("effects", "settings", ".", "boards", "worlds"),
    "benchmarks": (".", "lift_judge", "stereo", "motion", "yard"),
    "live": ("shared", ".", "crane", "soak"),
    "store": (".", "migrations", "migrations.versions"),
    "fleet": (".", "comparison"),
    "plant": (".", "opcua.security", "opcua", "links"),
    "cli": (".", "calibrate", "bench", "live", "yard", "store", "fleet", "plant", "acceptance"),
}  # fmt: skip
"""A room imports only from itself and from those before it; "." stands for the package's own modules."""
APART = {
    ("stereo.baselines", "stereo.direct"), ("stereo.baselines", "stereo.direct.semiglobal"),
    ("stereo.baselines", "stereo.direct.kernels"),
    ("motion.linear", "motion.crane"), ("motion.linear", "motion.frontend"),
    ("motion.linear", "motion.frame_to_frame"), ("motion.rig_check", "motion.fixed_lag"),
    ("yard.stability", "yard.bundles"), ("yard.stability", "yard.bundles.fitting"),
    ("yard.stability", "yard.bundles.section"),
    ("yard.lifting", "yard.bundles"), ("yard.lifting", "yard.bundles.fitting"),
    ("yard.lifting", "yard.bundles.section"),
    ("yard.placement", "yard.bundles"), ("yard.placement", "yard.bundles.fitting"),
    ("yard.placement", "yard.bundles.section"),
    ("yard.inventory", "yard.bundles"), ("yard.inventory", "yard.bundles.fitting"),
    ("yard.inventory", "yard.bundles.section"),
    ("yard.magnet", "yard.bundles"), ("yard.magnet", "yard.bundles.fitting"),
    ("yard.magnet", "yard.bundles.section"),
    ("yard.inventory", "yard.lifting"), ("yard.inventory", "yard.placement"),
    ("yard.inventory", "yard.magnet"),
    ("benchmarks.yard", "benchmarks.stereo"), ("benchmarks.yard", "benchmarks.motion"),
    ("benchmarks.motion", "benchmarks.stereo"), ("cli.bench", "cli.calibrate"),
    ("cli.yard", "cli.calibrate"), ("cli.yard", "cli.bench"),
    ("cli.store", "cli.calibrate"), ("cli.store", "cli.bench"), ("cli.store", "cli.yard"),
    ("cli.fleet", "cli.calibrate"), ("cli.fleet", "cli.bench"), ("cli.fleet", "cli.yard"),
    ("cli.fleet", "cli.store"),
}  # fmt: skip
"""Rooms of which the first doesn't import the second either."""
MAX_MODULES = 15
ROOT = Path(barsight.__file__).parent
OPTIONAL = {
    "viser": 1, "plotly": 1, "rosbags": 3, "pymunk": 1, "alembic": 8, "viva_genicam": 1, "fastapi": 5,
    "pypylon": 1, "mitsuba": 1, "drjit": 1, "uvicorn": 1, "zxingcpp": 1, "obstore": 1, "distributed": 1,
    "dask": 1,
    "asyncua": 1, "aiomqtt": 1, "snap7": 1, "reportlab": 1, "tesserocr": 1,
}  # fmt: skip
"""Optional libraries, and the number of files that import them: of rosbags two read and one writes, of
fastapi all that build routes."""


def imported_modules(tree: ast.AST) -> list[str]:
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the floor"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def room_of(module: str) -> tuple[str, str]:
    """Package and room of `motion.batch.fusion` (without `barsight.`): the longest name that ROOMS lists."""
    package, _, rest = module.partition(".")
    rooms = [r for r in ROOMS.get(package, ()) if rest == r or rest.startswith(f"{r}.")]
    return package, max(rooms, key=len, default=".")


def violations(module: str, source: str) -> list[str]:
    """Imports of `module` (without `barsight.`) that point up or across."""
    package, room = room_of(module)
    wrong: list[str] = []
    for name in imported_modules(ast.parse(source)):
        if not name.startswith("barsight."):
            continue
        other_package, other = room_of(name.removeprefix("barsight."))
        if other_package not in FLOORS:
            continue
        if other_package != package:
            up = FLOORS[other_package] >= FLOORS[package]
        elif package in ROOMS:
            order = ROOMS[package]
            up = order.index(other) > order.index(room)
            up = up or (f"{package}.{room}", f"{package}.{other}") in APART
        else:
            up = False
        if up:
            wrong.append(name)
    return wrong


SOURCES = sorted(path for path in ROOT.rglob("*.py") if path.parent != ROOT or path.stem[0] != "_")
FOLDERS = sorted({path.parent for path in SOURCES})


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path: Path) -> None:
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    package, room = room_of(module)
    assert package in FLOORS, f"{package} has no floor"
    assert path.stem == "__init__" or room in ROOMS.get(package, (".",)), (
        f"{module} is in no room of {package}"
    )
    assert violations(module, path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda p: str(p.relative_to(ROOT)))
def test_rooms_are_small_and_say_what_they_are_for(folder: Path) -> None:
    modules = [path for path in folder.glob("*.py") if not path.stem.startswith("__")]
    assert len(modules) <= MAX_MODULES
    assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8")))


def test_every_folder_has_its_place() -> None:
    for package, rooms in ROOMS.items():
        listed = {package.replace(".", "/")} | {f"{package}/{room.replace('.', '/')}" for room in rooms}
        found = {
            p.relative_to(ROOT).as_posix() for p in FOLDERS if p.relative_to(ROOT).parts[:1] == (package,)
        }
        assert found <= listed


@cache
def imported_packages(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {name.split(".")[0] for name in imported_modules(tree)}


@pytest.mark.parametrize("library", OPTIONAL)
def test_optional_libraries_are_imported_in_few_files(library: str) -> None:
    importing = [path for path in SOURCES if library in imported_packages(path)]
    assert len(importing) <= OPTIONAL[library]


def test_the_judge_of_lifts_shares_nothing_with_what_it_judges() -> None:
    room = sorted((ROOT / "benchmarks" / "lift_judge").glob("*.py"))
    names = {name for path in room for name in imported_modules(ast.parse(path.read_text(encoding="utf-8")))}
    own = {name for name in names if name.startswith("barsight.")}
    assert own and all(
        name.startswith(
            ("barsight.core.arrays.", "barsight.benchmarks.lift_judge.", "barsight.simulation.worlds.solids.")
        )
        for name in own
    )


def test_an_import_that_points_up_is_found() -> None:
    found = ["barsight.motion.crane"]
    assert violations("stereo.direct.pipeline", "from barsight.motion import crane") == found
    assert violations("stereo.sgbm", "import barsight.recording.base") == ["barsight.recording.base"]
    assert violations("motion.batch.fusion", "from barsight.stereo import sgbm") == []


def test_an_import_between_rooms_is_found() -> None:
    found = ["barsight.motion.batch.fusion.Fusion"]
    assert violations("motion.crane.sway", "from barsight.motion.batch.fusion import Fusion") == found
    assert violations("motion.fixed_lag.smoother", "from barsight.motion.batch.fusion import Fusion") == []
    across = "import barsight.stereo.direct.pipeline"
    assert violations("stereo.baselines.census", across) == ["barsight.stereo.direct.pipeline"]
    assert violations("stereo.settings", across) == []
    assert violations("stereo.sgbm", "from barsight.stereo import settings") == ["barsight.stereo.settings"]
