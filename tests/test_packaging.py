"""Imports, extras, locks and licences fit each other; the wheel is whole and runs without the checkout."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from importlib.metadata import packages_distributions
from importlib.metadata import version as installed_version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import barsight
import licences
import release_files

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "barsight"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
INSTALLED = packages_distributions() | {name: [name] for name in ("pypylon", "mitsuba", "drjit")}
"""These are too large for the development lock."""
EXTRAS = {
    "view": {"viewer/view.py"},
    "export": {"report/export.py"},
    "bench": {"features/detectors.py", "simulation/worlds/settling.py"},
    "notebook": {"yard/types.py"},
    "cameras": {"sensors/gige.py"},
    "basler": {"sensors/pylon.py"},
    "mitsuba": {"simulation/path_tracing.py"},
    "store": {
        "store/tables.py",
        "store/calibrations.py",
        "store/recordings.py",
        "store/opening.py",
        "store/audit.py",
        "store/states.py",
        "store/history.py",
        "store/adding.py",
        "store/lift_records.py",
        "store/migrations/env.py",
        "store/accounts.py",
        "store/confirmation.py",
        "store/promotion.py",
        "store/migrations/versions/v0003_fleet.py",
        "store/migrations/versions/v0004_places.py",
        "store/migrations/versions/v0005_equipment.py",
        "store/migrations/versions/v0006_touches.py",
        "store/touches.py",
        "fleet/records.py",
        "fleet/promoting.py",
        "plant/handshake.py",
        "store/migrations/versions/v0001_first.py",
        "store/migrations/versions/v0002_page.py",
        "page/conditions.py",
        "page/documents.py",
        "page/pictures.py",
        "page/layers.py",
        "page/model.py",
        "page/survey_files.py",
        "page/targets.py",
        "page/watch.py",
    },
    "fleet": {
        "fleet/objects.py",
        "fleet/limits.py",
        "fleet/scratch.py",
        "fleet/window.py",
        "fleet/cluster.py",
    },
    "page": {
        "page/api/app.py",
        "page/api/callers.py",
        "page/api/changing.py",
        "page/api/forms.py",
        "page/api/reading.py",
        "page/api/sessions.py",
        "page/api/serve.py",
    },
    "opcua": {
        "plant/opcua/security/binding.py",
        "plant/opcua/security/access.py",
        "plant/opcua/security/certificates.py",
    },
    "signing": {"report/signing.py"},
    "mqtt": {"plant/mqtt.py"},
    "s7": {"plant/s7.py"},
    "numbers": {"labels/number_reading.py"},
    "labels": {"labels/code_reading.py"},
    "acceptance": {"acceptance/pdf.py"},
}
"""Which modules may import what an extra installs."""


def named(requirements: list[str]) -> set[str]:
    return {canonicalize_name(Requirement(text).name) for text in requirements}


def imported(path: Path) -> set[str]:
    """Distributions whose packages a module imports anywhere."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add((node.module or "").split(".")[0])
    return {canonicalize_name(INSTALLED[name][0]) for name in names if name in INSTALLED} - {"barsight"}


def test_the_run_time_and_extras_are_what_is_imported() -> None:
    base = named(PROJECT["dependencies"])
    extras = {name: named(PROJECT["optional-dependencies"][name]) for name in EXTRAS}
    used: dict[str, set[str]] = {"base": set()} | {name: set() for name in EXTRAS}
    for path in SOURCE.rglob("*.py"):
        for package in imported(path):
            where = path.relative_to(SOURCE).as_posix()
            homes = [name for name, members in extras.items() if package in members]
            home = next((name for name in homes if where in EXTRAS[name]), None if homes else "base")
            assert home is not None, f"{where} needs {package} of an extra"
            used[home].add(package)
    assert base <= used["base"] <= licences.packages(PROJECT["dependencies"])
    assert {name: used[name] for name in EXTRAS} == extras


def test_nothing_for_users_is_under_the_gpl() -> None:
    names = set().union(*licences.sections().values())
    assert len(names) > 30
    copyleft = re.compile(r"\bA?GPL|(?<!Lesser )General Public License")
    assert {name: licences.licence(name) for name in names if copyleft.search(licences.licence(name))} == {}


def test_the_page_of_licences_is_current() -> None:
    assert licences.PAGE.read_text(encoding="utf-8") == licences.page(), "run: python tools/licences.py"


@pytest.mark.parametrize("lock", ["requirements.lock", "requirements-dev.lock"])
def test_locks_pin_with_hashes_and_name_no_index(lock: str) -> None:
    text = (ROOT / lock).read_text(encoding="utf-8")
    blocks = re.split(r"\n(?=\S)", text.strip())
    for block in blocks:
        assert re.match(r"[a-z0-9-]+(\[[a-z]+\])?==\S+( ; .*?)? \\\n    --hash=sha256:[0-9a-f]{64}", block), (
            block
        )
    assert "://" not in text
    locked = {re.split(r"[=\[]", block)[0] for block in blocks}
    wanted = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["view"], "setuptools"]
    if lock == "requirements-dev.lock":
        extras = PROJECT["optional-dependencies"]
        wanted += [text for extra in extras.keys() - {"basler", "mitsuba"} for text in extras[extra]]
    assert named(wanted) - {"barsight"} <= locked
    assert lock != "requirements.lock" or len(locked) + len(("barsight", "pip")) < 45 + len(
        {"colorama"} & locked
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, so that nothing of an earlier build gets in."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(SOURCE, folder / "src" / "barsight", ignore=shutil.ignore_patterns("__pycache__"))
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", str(folder), str(folder)], check=True)
    return next(folder.glob("*.whl"))


def test_the_wheel_holds_every_file_and_runs(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    inside = {path.relative_to(site).as_posix() for path in site.rglob("*") if path.is_file()}
    files = {path for path in SOURCE.rglob("*") if path.is_file() and path.parent.name != "__pycache__"}
    assert {path.relative_to(SOURCE.parent).as_posix() for path in files} <= inside
    version = PROJECT["version"]
    assert f"barsight-{version}.dist-info/licenses/LICENSE" in inside
    metadata = (site / f"barsight-{version}.dist-info" / "METADATA").read_text(encoding="utf-8")
    assert "License-Expression: Apache-2.0" in metadata
    shown = subprocess.run(
        [sys.executable, "-c", "import barsight, sys; from barsight.cli.main import run; "
         "print(barsight.__file__); sys.exit(run(['measure', '--help']))"],
        env=os.environ | {"PYTHONPATH": str(site)}, cwd=tmp_path, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert shown.startswith(str(site))
    assert "--preset" in shown


@pytest.mark.slow
def test_the_wheel_runs_the_demo_in_a_clean_environment(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    install = [str(python), "-m", "pip", "install", "--quiet", "--no-deps"]
    subprocess.run([*install, "--require-hashes", "-r", str(ROOT / "requirements.lock")], check=True)
    subprocess.run([*install, str(wheel)], check=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([str(python.with_name("barsight")), "demo"], cwd=tmp_path, env=environment, check=True)
    assert (tmp_path / "demo" / "result" / "report.html").stat().st_size > 10**6


def test_the_version_is_semantic_and_the_packages_own() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", PROJECT["version"])
    assert barsight.__version__ == PROJECT["version"]


@pytest.mark.slow
def test_sdist_and_wheel_have_the_same_bytes_each_time(tmp_path: Path) -> None:
    """Built from two copies with other times and rights of the files, in other folders."""
    built = []
    for name, rights, time_s in (("one", 0o600, 1_600_000_000), ("another", 0o664, 1_700_000_001)):
        copy = tmp_path / name
        shutil.copytree(SOURCE, copy / "src" / "barsight", ignore=shutil.ignore_patterns("__pycache__"))
        for file in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy(ROOT / file, copy)
        for path in copy.rglob("*"):
            if path.is_file():
                path.chmod(rights)
            os.utime(path, (time_s, time_s))
        built.append(release_files.build(copy, tmp_path / f"{name} dist", 1_750_000_000))
    for first, second in zip(*built, strict=True):
        assert first.name == second.name and first.read_bytes() == second.read_bytes()


@pytest.mark.slow
def test_the_bill_of_materials_names_every_package_with_version_licence_and_hash(tmp_path: Path) -> None:
    target = tmp_path / "sbom.cdx.json"
    subprocess.run([sys.executable, str(ROOT / "tools" / "sbom.py"), str(target)], check=True)
    bill = json.loads(target.read_text(encoding="utf-8"))
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    parts = {part["name"]: part for part in bill["components"]}
    assert set(parts) == set().union(*licences.sections().values())
    for name, part in parts.items():
        assert part["version"] == installed_version(name) and part["licenses"]
        assert part["externalReferences"][0]["hashes"]
    needs = {each["ref"]: each.get("dependsOn", []) for each in bill["dependencies"]}
    assert needs["scipy"] == ["numpy"] and set(needs["barsight"]) == set(parts)
