"""Write the pages of docs/reference that the code defines: `python tools/reference.py`.

Commands come from the table of commands and the functions that they give to tyro, settings from the
dataclasses that these functions take, codes and schemas from their tables in the package.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import inspect
import io
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn, cast, get_type_hints

import docstring_parser
import tyro

import barsight
from barsight.cli import main
from reference_codes import alarms_table, codes_page
from reference_schemas import schemas_page
from reference_settings import (
    CRANE,
    MAGNET,
    PLANT,
    Use,
    own_defaults,
    settings_page,
    shown,
    type_text,
    walk,
)

PAGES = Path(__file__).parents[1] / "docs" / "reference"
PACKAGE = Path(barsight.__file__).parent
HEAD = "<!-- Made by tools/reference.py from the code. Don't edit. -->\n\n"


class Parsed(BaseException):
    """A command line reached tyro; holds the function that it would have called."""

    def __init__(self, function: Callable[..., None]) -> None:
        self.function = function


@dataclasses.dataclass(frozen=True)
class Command:
    """Words after `barsight`, and the function whose signature is its command line."""

    words: tuple[str, ...]
    function: Callable[..., None]


def find(name: str) -> Any:
    """The class, function or table `name` at the top of a module of the package, wherever it lies."""
    top = re.compile(rf"^(class |def )?{name}\b", re.MULTILINE)
    for path in sorted(PACKAGE.rglob("*.py")):
        if top.search(path.read_text(encoding="utf-8")):
            dotted = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
            return getattr(importlib.import_module(dotted), name)
    raise LookupError(f"the package defines no {name}")


def commands() -> Iterator[Command]:
    """Every command, and the sub-commands of those that have any."""
    for name in main.COMMANDS:
        function, told = _reached(name)
        if function is not None:
            yield Command((name,), function)
            for word in main.SECOND.get(name, ()):
                function, _ = _reached(name, word)
                assert function is not None
                yield Command((name, word), function)
            continue
        for word in dict.fromkeys(re.findall(r"[a-z][a-z-]+", told)):
            function, _ = _reached(name, word)
            if function is not None:
                yield Command((name, word), function)


def _reached(*words: str) -> tuple[Callable[..., None] | None, str]:
    """The function that `words` alone lead to, or None with what `words --help` prints."""

    def stop(function: Callable[..., None], **_: object) -> NoReturn:
        raise Parsed(function)

    parse, tyro.cli = tyro.cli, cast(Any, stop)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
            main.run(list(words))
            main.run([*words, "--help"])
    except Parsed as reached:
        return reached.function, ""
    finally:
        tyro.cli = parse
    return None, printed.getvalue()


def commands_page(all_commands: list[Command]) -> str:
    """A section for each command: what it does, its arguments, and which settings it takes."""
    rows = "".join(f"| [`{name}`](#{name}) | {about} |\n" for name, about in main.COMMANDS.items())
    lines = [HEAD, "# Commands\n\n", f"| command | what |\n|---|---|\n{rows}"]
    headed = set(main.SECOND)
    for command in all_commands:
        if len(command.words) > 1 and command.words[0] not in headed:
            headed.add(command.words[0])
            lines.append(f"\n## {command.words[0]}\n\n{main.COMMANDS[command.words[0]]}.\n")
        lines.append(_section(command))
    return "".join(lines)


def _section(command: Command) -> str:
    described = docstring_parser.parse(inspect.getdoc(command.function) or "")
    about = {parameter.arg_name: parameter.description or "" for parameter in described.params}
    text = "\n\n".join(filter(None, (described.short_description, described.long_description)))
    rows, taken = [], []
    hints = get_type_hints(command.function, include_extras=True)
    for name, parameter in inspect.signature(command.function).parameters.items():
        use = Use.of(name, hints[name])
        if dataclasses.is_dataclass(use.kind):
            kind = cast(type, use.kind)
            anchor = kind.__name__.lower()
            where = f"`--{use.prefix}.*`" if use.prefix else "flags without a prefix"
            taken.append(f"[`{kind.__name__}`](settings.md#{anchor}) ({where})")
            continue
        default = "required" if parameter.default is inspect.Parameter.empty else shown(parameter.default)
        said = " ".join(about.get(name, "").split())
        rows.append(f"| {use.spelled} | {type_text(use.kind)} | {default} | {said} |\n")
    depth = "#" * (len(command.words) + 1)
    section = f"\n{depth} {' '.join(command.words)}\n\n{text}\n\n"
    section += "| argument | type | default | meaning |\n|---|---|---|---|\n" + "".join(rows) if rows else ""
    return section + (f"\nSettings: {', '.join(taken)}.\n" if taken else "")


def settings_uses(all_commands: list[Command]) -> dict[type, list[tuple[str, str]]]:
    """Each settings class with the (command, prefix) pairs that reach it; "" is no prefix."""
    uses: dict[type, list[tuple[str, str]]] = {}
    for command in all_commands:
        for name, hint in get_type_hints(command.function, include_extras=True).items():
            use = Use.of(name, hint)
            for kind, prefix in walk(use.kind, use.prefix):
                uses.setdefault(kind, []).append((" ".join(command.words), prefix))
    for name, file in (("Magnet", MAGNET), ("CraneConfig", CRANE), ("PlantSettings", PLANT)):
        for kind, prefix in walk(find(name), ""):
            if not prefix.startswith("measure."):  # as --config has them
                uses.setdefault(kind, []).append((file, prefix))
    return uses


def pages() -> dict[str, str]:
    """The text of each page by its file name."""
    all_commands = list(commands())
    words = json.loads((PACKAGE / "page" / "static" / "words.json").read_text(encoding="utf-8"))
    alarms = alarms_table(words, find("alarm_priority"))
    return {
        "commands.md": commands_page(all_commands),
        "settings.md": HEAD
        + settings_page(settings_uses(all_commands), own_defaults(find("MeasureSettings")())),
        "codes.md": HEAD
        + codes_page(find("BarsightError"), find("VETOES"), find("WARNINGS"), main.INTERRUPTED, alarms),
        "telegram.md": HEAD + find("telegram_page")(),
        "schemas.md": HEAD + schemas_page(PACKAGE),
    }


if __name__ == "__main__":
    for page, content in pages().items():
        (PAGES / page).write_text(content, encoding="utf-8")
