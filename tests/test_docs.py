"""The documents hold: blocks run, commands parse, links lead somewhere, and made pages are current."""

import dataclasses
import functools
import importlib.util
import itertools
import re
import shlex
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import tyro

from barsight.cli import main
from barsight.core.records.heights import Agreement
from barsight.core.settings.file import read_settings
from barsight.plant.settings import LINKS, read_plant
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.description import Magnet, example_magnet
from cli_runs import FAST

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").rglob("*.md")])
MANUALS = [page for page in PAGES if "benchmarks" not in page.parts and page.name != "CHANGELOG.md"]


def blocks(page: Path, language: str) -> list[str]:
    return [text for kind, text in BLOCK.findall(page.read_text(encoding="utf-8")) if kind == language]


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.fixture(scope="module")
def reference() -> ModuleType:
    """tools/reference.py, which is no part of the package."""
    folder = ROOT / "tools"
    sys.path.insert(0, str(folder))
    spec = importlib.util.spec_from_file_location("reference", folder / "reference.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["reference"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", [p for p in MANUALS if blocks(p, "python")], ids=name)
def test_python_blocks_run(page: Path, recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(recording.parent)
    Path("demo").mkdir()
    Path("demo/recording").symlink_to(recording)
    Path("demo/magnet.toml").write_text(example_magnet(), encoding="utf-8")
    if "demo/result" in page.read_text(encoding="utf-8"):
        assert main.run(["measure", str(recording), "-o", "demo/result", *FAST]) == 0
    namespace: dict[str, object] = {}
    for block in blocks(page, "python"):
        exec(compile(block, name(page), "exec"), namespace)


def test_pages_made_from_the_code_are_current(reference: ModuleType) -> None:
    stale = [
        page
        for page, content in reference.pages().items()
        if (ROOT / "docs" / "reference" / page).read_text(encoding="utf-8") != content
    ]
    assert stale == [], "run python tools/reference.py"


def shown_commands() -> list[tuple[str, str]]:
    """Page and command of each line of a shell block that calls barsight, comments and chains taken off."""
    found = []
    for page in MANUALS:
        for line in itertools.chain.from_iterable(text.splitlines() for text in blocks(page, "sh")):
            for part in line.split(" && "):
                command = part.split("  #")[0].strip()
                if command.removeprefix(".venv/bin/").startswith("barsight "):
                    found.append((name(page), command.removeprefix(".venv/bin/").removeprefix("barsight ")))
    return found


@pytest.mark.parametrize(("page", "command"), shown_commands())
def test_shown_commands_parse(
    page: str, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parse, called = tyro.cli, []

    def parse_only(function: Callable[..., None], **options: Any) -> None:
        @functools.wraps(function)
        def note(*args: object, **kwargs: object) -> None:
            called.append(function)

        parse(note, **options)

    monkeypatch.setattr(tyro, "cli", parse_only)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "settings.toml").write_text("")
    (crane,) = blocks(ROOT / "docs" / "how-to" / "run-a-crane.md", "toml")
    (tmp_path / "crane.toml").write_text(crane, encoding="utf-8")
    assert main.run(shlex.split(command)) == 0
    assert called


def test_named_flags_exist(reference: ModuleType) -> None:
    known = {
        "--help",
        "--quiet",
        "--editable",
        "--require-hashes",
        "--no-deps",
        "--no-build-isolation",
    }
    known |= {"--minutes"}  # of python -m fuzz
    for kind, reached in reference.settings_uses(list(reference.commands())).items():
        fields = [field.name.replace("_", "-") for field in reference.dataclasses.fields(kind)]
        known |= {f"--{prefix}.{field}".replace("--.", "--") for _, prefix in reached for field in fields}
        known |= {f"--{prefix}.*" for _, prefix in reached}
    made = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    known |= set(re.findall(r"--[\w.-]+", made))
    for attack in ("__main__.py", "faults.py"):
        known |= set(re.findall(r'"(--[a-z]+)"', (ROOT / "fuzz" / attack).read_text(encoding="utf-8")))
    unknown = {
        (name(page), flag)
        for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
        for flag in re.findall(r"(?<![\w-])--[a-z][\w.*-]*", page.read_text(encoding="utf-8"))
        if flag.rstrip(".") not in known
    }
    assert unknown == set()


def test_toml_blocks_are_valid(tmp_path: Path) -> None:
    for page in MANUALS:
        for block in blocks(page, "toml"):
            tomllib.loads(block)
    (magnet,) = blocks(ROOT / "docs" / "how-to" / "describe-a-magnet.md", "toml")
    path = tmp_path / "magnet.toml"
    path.write_text(magnet)
    assert read_settings(path, Magnet, "", "magnet").safety_factor >= 2
    (plant,) = blocks(ROOT / "docs" / "how-to" / "connect-a-plant.md", "toml")
    path.write_text(plant)
    assert read_plant(path).links == LINKS


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", head).strip().lower()) for head in headings}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), target
        assert not anchor or anchor in anchors(found), target


def test_pages_that_code_and_texts_name_exist() -> None:
    named = re.compile(r"(?:docs|benchmarks/results)/[\w/.-]+\.(?:md|png|jpg)")
    texts = [*PAGES, *(ROOT / "src").rglob("*.py"), *(ROOT / "tests").rglob("*.py")]
    missing = {
        (name(text), page)
        for text in texts
        for page in named.findall(text.read_text(encoding="utf-8"))
        if not (ROOT / page).is_file()
    }
    assert missing == set()


def test_where_to_look_is_current() -> None:
    """Each row of the table in CONTRIBUTING names what is there, and no room of the package is left out."""
    package, text = ROOT / "src" / "barsight", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = text[text.index("| you look for |") : text.index("The commands you need")]
    named = set(re.findall(r"`([\w/]+(?:\.py)?)`", table.split("|---|---|")[1]))
    assert [path for path in named if not (package / path).exists()] == []
    rooms = {path.parent.name for path in package.glob("*/__init__.py")}
    assert rooms - {path.split("/")[0] for path in named} == set()


def test_every_veto_is_tripped_by_a_test(reference: ModuleType) -> None:
    tests = "".join(path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py"))
    assert [code for code in reference.find("VETOES") if f'"{code}"' not in tests] == []


def test_warnings_are_those_of_the_table(reference: ModuleType) -> None:
    source = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    raised = set(re.findall(r'Notice\(\s*"([a-z-]+)"', source)) | {"no-overlap"}
    assert raised == set(reference.find("WARNINGS"))


@pytest.mark.parametrize("record", [Agreement, Travel], ids=["agreement", "travel"])
def test_figures_of_result_json_are_described(record: type) -> None:
    text = (ROOT / "docs" / "reference" / "results.md").read_text(encoding="utf-8")
    assert [field.name for field in dataclasses.fields(record) if f"`{field.name}`" not in text] == []


def test_readme_leads_to_every_command() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    made = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    assert "docs/reference/commands.md" in readme
    assert [command for command in main.COMMANDS if f"\n## {command}\n" not in made] == []


def test_every_command_is_shown_outside_the_reference() -> None:
    """A how-to, the tour or the paper's page shows each, in a shell line or a sentence."""
    pages = [*(ROOT / "docs" / "how-to").glob("*.md"), ROOT / "docs" / "tour.md", ROOT / "docs" / "paper.md"]
    told = " ".join(page.read_text(encoding="utf-8") for page in pages)
    assert [command for command in main.COMMANDS if not re.search(rf"barsight {command}\b", told)] == []


def test_index_and_menu_lead_to_every_page() -> None:
    docs = ROOT / "docs"
    pages = {page.relative_to(docs).as_posix() for page in docs.rglob("*.md")} - {"index.md"}
    index = (docs / "index.md").read_text(encoding="utf-8")
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert pages - set(re.findall(r"\(([\w/.-]+\.md)\)", index)) == set()
    assert pages - set(re.findall(r"[\w/.-]+\.md", menu)) == set()


def test_ci_runs_readmes_test_command() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    test_command = next(line for line in readme.splitlines() if line.endswith("-m pytest"))
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    steps = [ci.index(step) for step in test_command.split(" && ")]
    assert steps == sorted(steps)
    assert steps[-1] == len(ci) - 1
