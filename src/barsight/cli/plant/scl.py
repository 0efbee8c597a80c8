"""Run `barsight plant scl -o FILE`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from barsight.cli.arguments import call
from barsight.core.files import atomic_path
from barsight.plant.telegram_texts import scl_source


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and write the source."""

    def command(out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]) -> None:
        """Write the telegram's types and data blocks as a source file for TIA Portal (SCL, S7-1500).

        Args:
            out: The file to write, such as barsight.scl.
        """
        with atomic_path(out) as path:
            path.write_text(scl_source(), encoding="utf-8", newline="\r\n")

    call(command, "plant scl", arguments)
