"""Settings dataclasses as tables: names, types, defaults and the docstring after each field."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
import types
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

import tyro

_POSITIONAL = cast(Any, tyro.conf.Positional[int]).__metadata__[0]
_NAMES = {int: "whole number", float: "number", str: "text", bool: "yes or no", Path: "path"}
MAGNET, CRANE, PLANT = "a magnet's file", "crane.toml", "plant.toml"
FILES = (MAGNET, CRANE, PLANT)
"""Files that hold settings, beside flags and the files of `--config`."""


@dataclass(frozen=True)
class Use:
    """A parameter of a command: its type without annotations, its flag's prefix, and how it is spelled."""

    kind: Any
    prefix: str
    spelled: str

    @staticmethod
    def of(name: str, hint: Any) -> Use:
        """Read tyro's annotations of a parameter."""
        kind, marks = (get_args(hint)[0], hint.__metadata__) if get_origin(hint) is Annotated else (hint, ())
        if _POSITIONAL in marks:
            return Use(kind, "", f"`{name.upper()}`")
        renamed = [mark.name for mark in marks if getattr(mark, "name", None) is not None]
        aliases = [alias for mark in marks for alias in getattr(mark, "aliases", None) or ()]
        prefix = (renamed or [name])[0]
        return Use(kind, flag(prefix), ", ".join(f"`{s}`" for s in (*aliases, f"--{flag(prefix)}")))


def flag(name: str) -> str:
    """A field's name as the command line spells it."""
    return name.replace("_", "-")


def walk(kind: Any, prefix: str) -> Iterator[tuple[type, str]]:
    """A dataclass and those in its fields (in tuples and unions too), each with its dotted prefix."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        yield kind, prefix
        for name, hint in get_type_hints(kind).items():
            if name in {field.name for field in dataclasses.fields(kind)}:
                yield from walk(hint, f"{prefix}.{flag(name)}".lstrip("."))
        return
    for part in get_args(kind) if get_origin(kind) is not Literal else ():
        yield from walk(part, prefix)


def own_defaults(settings: Any, path: str = "") -> dict[tuple[type, str], list[str]]:
    """Defaults that parts of `settings` have in place of their classes', such as "`9` in `map`"."""
    found: dict[tuple[type, str], list[str]] = {}
    for field in dataclasses.fields(settings):
        value, dotted = getattr(settings, field.name), f"{path}.{field.name}".lstrip(".")
        if dataclasses.is_dataclass(value):
            for key, said in own_defaults(value, dotted).items():
                found.setdefault(key, []).extend(said)
        elif path and shown(value) != _default(field):
            found.setdefault((type(settings), field.name), []).append(f"{shown(value)} in `{path}`")
    return found


def settings_page(uses: dict[type, list[tuple[str, str]]], own: dict[tuple[type, str], list[str]]) -> str:
    """A section for each class: who takes it under which prefix, then a row a field. own: `own_defaults`."""
    lines = [
        "# Settings\n\nEvery setting is a flag (`--map.cell-m 0.02`) and a key of a TOML file "
        "(`[map]`, `cell_m = 0.02`) for the commands that take `--config`. A flag overrides the file. A "
        "part's flags begin as its section says: `--map.*` means `--map.cell-m` and so on. Where a part has "
        "a default of its own, the column *default* names the part.\n"
    ]
    for kind, reached in uses.items():
        about = "" if (kind.__doc__ or "").startswith(f"{kind.__name__}(") else inspect.getdoc(kind) or ""
        lines.append(f"\n## {kind.__name__}\n\n{about}\n\n{_reached_by(reached)}\n\n")
        lines.append("| setting | type | default | meaning |\n|---|---|---|---|\n")
        said, hints = documented(kind), get_type_hints(kind)
        for field in dataclasses.fields(kind):
            inner = next((found for found, _ in walk(hints[field.name], "")), None)
            if inner is not None:
                linked = f"[{inner.__name__}](#{inner.__name__.lower()})"
                lines.append(
                    f"| `{field.name}` | {linked} | | {said.get(field.name) or _first_line(inner)} |\n"
                )
                continue
            default = "; ".join([_default(field), *own.get((kind, field.name), ())])
            told = f"{type_text(hints[field.name])} | {default} | {said.get(field.name, '')}"
            lines.append(f"| `{field.name}` | {told} |\n")
    return "".join(lines)


def _reached_by(reached: list[tuple[str, str]]) -> str:
    by_prefix: dict[str, list[str]] = {}
    for command, prefix in reached:
        by_prefix.setdefault(prefix, []).append(command)
    said = []
    for prefix, names in by_prefix.items():
        place = f"`{prefix}`" if prefix else "the file itself"
        said += [f"In {file}: {place}." for file in FILES if file in names]
        commands = [name for name in dict.fromkeys(names) if name not in FILES]
        if commands:
            flags = f"`--{prefix}.*`" if prefix else "No prefix"
            said.append(f"{flags}: {', '.join(f'`{name}`' for name in commands)}.")
    return " ".join(said)


def documented(kind: type) -> dict[str, str]:
    """The docstring after each field of a class and its bases, on one line."""
    said: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(tree, ast.ClassDef)
        for field, after in pairwise(tree.body):
            if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
                said[ast.unparse(field.target)] = _cell(str(ast.literal_eval(after.value)))
    return said


def type_text(kind: Any) -> str:
    """A type in words."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return type_text(inner[0])
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in inner)
    if inspect.isclass(kind) and issubclass(kind, StrEnum):
        return ", ".join(f"`{member.value}`" for member in kind)
    if origin in (Union, types.UnionType):
        return " or ".join(type_text(part) for part in inner if part is not type(None))
    if origin is tuple and inner[-1] is Ellipsis:
        return f"list of: {type_text(inner[0])}"
    if origin is tuple:
        return f"{len(inner)} of: {type_text(inner[0])}"
    return _NAMES.get(kind, f"`{getattr(kind, '__name__', kind)}`")


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
        return shown(field.default)
    if field.default_factory is not dataclasses.MISSING:
        return shown(field.default_factory())
    return "required"


def shown(value: Any) -> str:
    """A default as a cell of a table."""
    if value is None or value == ():
        return "none"
    if isinstance(value, tuple):
        return ", ".join(shown(part) for part in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"`{value}`"


def _first_line(kind: type) -> str:
    return _cell((inspect.getdoc(kind) or "").split("\n\n")[0])


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
