"""Parse command lines from function signatures and frozen settings (tyro), optionally with a TOML file."""

from __future__ import annotations

import functools
import importlib
import inspect
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin, get_type_hints

import tyro

from barsight.core.errors import ConfigError, InputError
from barsight.core.printing import printable
from barsight.core.settings.file import read_settings
from barsight.core.settings.renamed import refuse_old_flags

Settings = TypeVar("Settings")
LISTS = ("--use", "--lifted", "--fetch")
"""Flags whose values may be separated by commas."""
_POSITIONAL = cast(Any, tyro.conf.Positional[int]).__metadata__[0]
_WORDS = {Path: "PATH", str: "STR", int: "INT", float: "FLOAT"}


def call(command: Callable[..., None], name: str, arguments: Sequence[str]) -> None:
    """Parse `arguments` according to the function's signature and call it; wrong usage exits with code 2."""
    refuse_old_flags(arguments)
    listed = _listed(arguments)
    _prepare_help(command)
    shown = [printable(argument) for argument in listed]
    if shown != listed:  # tyro prints rejected arguments unescaped
        tyro.cli(_only_parsed(command), prog=f"barsight {name}", args=shown, compact_help=False)
    tyro.cli(command, prog=f"barsight {name}", args=listed, compact_help=False)


def _prepare_help(command: Callable[..., None]) -> None:
    """Give positional arguments their own names in usage and help, RECORDING instead of PATH, others that may
    be left out one word, PATH instead of {None}|PATH, and let each description flow as one paragraph.
    """
    command.__doc__ = re.sub(r"\n {8,}(?=\S)", " ", inspect.getdoc(command) or "")
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        hint, word = hints[name], name.upper()
        kind, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        if _POSITIONAL not in marks:
            inner = [one for one in get_args(kind) if one in _WORDS]
            if type(None) in get_args(kind) and len(inner) == 1:
                hints[name] = Annotated[hint, tyro.conf.arg(metavar=_WORDS[inner[0]])]
            continue
        if get_origin(kind) is tuple:  # one or more
            shown = tyro.conf.arg(metavar=f"{word[:-1]} [...]", help_behavior_hint="(required)")
        else:
            needed = parameter.default is parameter.empty
            shown = tyro.conf.arg(metavar=word if needed else f"[{word}]")
        hints[name] = Annotated[hint, shown]
    command.__annotations__.update(hints)


def _only_parsed(command: Callable[..., None]) -> Callable[..., None]:
    """Make a function with the same signature that does nothing."""
    return functools.wraps(command)(lambda *_, **__: None)


def by_own_flags(error: InputError) -> InputError:
    """Replace the name of a recording's setting in an error's remedy with this command's flag for it:
    --camchain instead of recording.camchain.
    """
    remedy = re.sub(r"\brecording\.(\w+)", lambda m: "--" + m[1].replace("_", "-"), error.remedy)
    return InputError(error.path, error.problem, remedy)


def pass_on(name: str, noun: str, kinds: Mapping[str, str], arguments: Sequence[str]) -> None:
    """Pass the rest of `name KIND ...` on to the module of that kind.

    kinds: the kinds with their summaries. noun: the word for a kind in error messages.
    """
    if not arguments:
        raise ConfigError(f"{name} needs a kind: {', '.join(kinds)}; --help says what each does")
    if arguments[0] in ("-h", "--help"):
        print_kinds(name, kinds)
        return
    kind, rest = arguments[0], arguments[1:]
    if kind not in kinds:
        raise ConfigError(f"there is no {noun} {kind!r}; known are {', '.join(kinds)}")
    importlib.import_module(f"barsight.cli.{name}.{kind.replace('-', '_')}").run(rest)


def print_kinds(name: str, kinds: Mapping[str, str]) -> None:
    """Print the help of a command that has kinds, each with its summary."""
    width = max(map(len, kinds)) + 1
    lines = "\n".join(f"  {kind:<{width}}{summary}" for kind, summary in kinds.items())
    sys.stdout.write(
        f"usage: barsight {name} KIND ...\n\nkinds:\n{lines}\n\nbarsight {name} KIND --help explains one.\n"
    )


def _listed(arguments: Sequence[str]) -> list[str]:
    """Rewrite `--use stereo,imu` as `--use stereo imu`, and the same for the other LISTS.

    Raises ConfigError where one has no value, as from a script whose variable was empty. Before -h and --help
    it may be missing.
    """
    if {"-h", "--help"} & set(arguments):
        return [*takewhile(lambda one: one.partition("=")[0] not in LISTS, arguments), "--help"]
    listed: list[str] = []
    for argument in arguments:
        flag, equals, value = argument.partition("=")
        if flag in LISTS and equals:
            listed += [flag, *value.split(",")]
        elif listed and listed[-1] in LISTS:
            listed += argument.split(",")
        else:
            listed.append(argument)
    for argument, after in pairwise([*listed, "--"]):
        if argument in LISTS and after[:1] == "-" and not after[1:].isdigit():
            raise ConfigError(f"{argument} has no value; give one or more, or leave it out")
    return listed


def config_path(arguments: Sequence[str]) -> Path | None:
    """Find FILE in `--config FILE` or `--config=FILE`, which is needed before the other flags are parsed."""
    for number, argument in enumerate(arguments):
        if argument == "--config" and number + 1 < len(arguments):
            return Path(arguments[number + 1])
        if argument.startswith("--config="):
            return Path(argument.partition("=")[2])
    return None


def load_settings(path: Path | None, kind: type[Settings]) -> Settings:
    """Load settings of `kind` from a TOML file over the defaults, or the defaults where path is None.

    Raises InputError for a file that can't be read and ConfigError for an invalid key or value.
    """
    if path is None:
        return kind()
    return read_settings(path, kind, "barsight measure --help lists the settings", "config")
