"""Exit codes, warnings and vetoes as tables."""

from __future__ import annotations

import inspect
from typing import Any


def codes_page(error: type[Any], vetoes: dict[str, str], warnings: dict[str, str], interrupted: int) -> str:
    """error: the root of the exceptions that end a run, each with its `exit_code`."""
    exits = {0: "Done."}
    for kind in _family(error):
        if "exit_code" in vars(kind):
            exits[kind.exit_code] = (inspect.getdoc(kind) or "").splitlines()[0]
    exits[interrupted] = "Interrupted (Ctrl-C or a signal); nothing half-written is left."
    return (
        "# Codes\n\n## Exit codes\n\nWrong usage of the command line ends with 2 too.\n\n"
        + _table("code", {str(code): exits[code] for code in sorted(exits)})
        + "\n## Warnings\n\nIn `warnings` of `result.json`; the run went on.\n\n"
        + _table("code", warnings)
        + "\n## Vetoes\n\nIn `vetoes` of `lifts.json`, for the whole map or for one lift.\n\n"
        + _table("code", vetoes)
    )


def _family(kind: type[Any]) -> list[type[Any]]:
    children: list[type[Any]] = kind.__subclasses__()
    return [kind, *(below for child in children for below in _family(child))]


def _table(head: str, rows: dict[str, str]) -> str:
    body = "".join(f"| `{code}` | {meaning} |\n" for code, meaning in rows.items())
    return f"| {head} | meaning |\n|---|---|\n{body}"
