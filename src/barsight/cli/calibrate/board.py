"""Run `barsight calibrate board --board BOARD -o board.png`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from PIL import Image

from barsight.calibration.boards.board import parse_board
from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.files import atomic_path, expect_output
from barsight.simulation.boards.drawing import draw_board, draw_views

INCH_M = 0.0254
MAX_PX = 30_000


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and draw the board."""

    def command(
        board: str,
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        dpi: int = 300,
        views: bool = False,
    ) -> None:
        """Draw a calibration board for printing at true size.

        Args:
            board: checkerboard:9x6:0.025, charuco:11x8:0.03:0.022[:DICTIONARY] or aprilgrid:6x6:0.088:0.3.
            out: The picture (.png or .pdf). Print it at 100 % and measure the print afterwards.
            dpi: Dots per inch.
            views: Draw how to hold the board in front of the cameras instead.
        """
        expect_output(out, ".png", ".pdf")
        target = parse_board(board)
        if not 30 <= dpi <= 2400:
            raise ConfigError(f"--dpi {dpi} is out of range; give 30 to 2400")
        longest = (max(target.columns, target.rows) + 3) * target.size_m * (1 + target.spacing) * dpi / INCH_M
        if longest > MAX_PX:
            raise ConfigError(f"--dpi {dpi} makes {longest:.0f} px of this board; give less")
        drawn = draw_views(target) if views else draw_board(target, dpi / INCH_M, target.size_m)
        with atomic_path(out) as path:
            Image.fromarray(drawn).save(path, format=out.suffix[1:].upper(), dpi=(dpi, dpi), resolution=dpi)
        size = " x ".join(f"{side * INCH_M / dpi:.3f} m" for side in drawn.shape[::-1])
        text = f"{out}: {'how to hold it' if views else f'{size} with its margin, at {dpi} dpi'}"
        SafeConsole(stderr=True).print_line(text)

    call(command, "calibrate board", arguments)
