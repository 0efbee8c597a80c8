"""Run `barsight export OUT FILE`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tyro

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import OutputError
from barsight.report.export import export
from barsight.report.files.result_files import RESULT_FILES


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and write the file."""

    def command(out: tyro.conf.Positional[Path], file: tyro.conf.Positional[Path]) -> None:
        """Write a measured cloud (.ply .pcd .las .laz .e57 .csv) or height map (.tif) for other programs.

        Args:
            out: A folder of results from barsight measure.
            file: The file to write; its suffix selects the format.
        """
        if file.name in RESULT_FILES and file.resolve().parent == out.resolve():
            raise OutputError(f"{file}: is a file of the result itself; name another")
        points = export(out, file)
        remark = f" ({points} points)" if points else ""
        SafeConsole(stderr=True).print_line(f"written: {file}{remark}")

    call(command, "export", arguments)
