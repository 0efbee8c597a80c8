"""Exit codes, warnings, vetoes and alarms as tables."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def codes_page(
    error: type[Any], vetoes: dict[str, str], warnings: dict[str, str], interrupted: int, alarms: str
) -> str:
    """error: the root of the exceptions that end a run, each with its `exit_code`. alarms: their table."""
    exits = {0: "Done."}
    for kind in _family(error):
        if "exit_code" in vars(kind):
            exits[kind.exit_code] = (inspect.getdoc(kind) or "").splitlines()[0]
    exits[error.exit_code] = "The system failed: a file, the memory, the reader of the output."
    exits[interrupted] = "Interrupted (Ctrl-C or a signal); nothing half-written is left."
    return (
        "# Codes\n\n## Exit codes\n\nWith any code but 0, standard error says why. A bug of Barsight's own "
        "ends with a traceback and 1.\n\n"
        + _table("code", {str(code): exits[code] for code in sorted(exits)})
        + "\n## Warnings\n\nIn `warnings` of `result.json`; the run went on.\n\n"
        + _table("code", warnings)
        + "\n## Vetoes\n\nIn `vetoes` of `lifts.json`, for the whole map or for one lift.\n\n"
        + _table("code", vetoes)
        + "\n## Alarms\n\nOn the page and in the plant's links. Programs may raise others.\n\n"
        + alarms
    )


def alarms_table(words: Mapping[str, Sequence[str]], priority: Callable[[str], int]) -> str:
    """The page's alarms, in its words: priority, meaning, cause and action."""
    rows = ""
    for key in words:
        if key.startswith("alarm."):
            code = key.removeprefix("alarm.")
            said = " | ".join(words[f"{part}.{code}"][0] for part in ("alarm", "cause", "action"))
            rows += f"| `{code}` | {priority(code)} | {said} |\n"
    return f"| code | priority | meaning | cause | do |\n|---|---|---|---|---|\n{rows}"


def _family(kind: type[Any]) -> list[type[Any]]:
    children: list[type[Any]] = kind.__subclasses__()
    return [kind, *(below for child in children for below in _family(child))]


def _table(head: str, rows: dict[str, str]) -> str:
    body = "".join(f"| `{code}` | {meaning} |\n" for code, meaning in rows.items())
    return f"| {head} | meaning |\n|---|---|\n{body}"
