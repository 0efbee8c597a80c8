"""Dispatch `barsight store KIND ...` to what is asked of the store."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from barsight.core.errors import ConfigError

KINDS = {
    "add": "Add a measured folder: its bundles get names that they keep",
    "list": "List the surveys, and the bundles of the present yard",
    "verify": "Check the audit chain and the rows that it covers; exit code 5 where they don't hold",
}


def run(arguments: Sequence[str]) -> None:
    """Pass the rest of the line on."""
    if not arguments:
        raise ConfigError(f"store needs a word: {', '.join(KINDS)}; --help says what each does")
    if arguments[0] in ("-h", "--help"):
        lines = "\n".join(f"  {name:<8}{summary}" for name, summary in KINDS.items())
        sys.stdout.write(f"usage: barsight store {'|'.join(KINDS)} ...\n\n{lines}\n\n")
        return
    kind, rest = arguments[0], arguments[1:]
    if kind not in KINDS:
        raise ConfigError(f"store can't {kind!r}; known are {', '.join(KINDS)}")
    importlib.import_module(f"barsight.cli.store.{kind}").run(rest)
