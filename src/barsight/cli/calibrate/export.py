"""Run `barsight calibrate export RIG -o FILE --to FORMAT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape

from barsight.calibration.files.rig_formats import RigFormat, read_rig_file, write_any_rig
from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and write the rig."""

    def command(
        rig: tyro.conf.Positional[Path],
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        to: tyro.conf.EnumChoicesFromValues[RigFormat],
    ) -> None:
        """Write a stereo rig in another format.

        Args:
            rig: The rig to read: Barsight's or OpenCV's file, Kalibr's camchain, or an EuRoC folder.
            out: The file to write (the folder, for euroc).
            to: The format to write. OpenCV's files lose the rig's mounting on its body, and all formats but
                Barsight's lose the covariance. Kalibr accepts lenses with four coefficients; others are
                approximated by four, and refused if the error exceeds 0.1 px.
        """
        read = read_rig_file(rig)
        off_px = write_any_rig(out, read, to)
        fitted = f"; lenses of four coefficients, up to {off_px:.3f} px off" if off_px else ""
        SafeConsole(stderr=True).print(
            f"{escape(str(out))}: baseline {read.baseline_m * 1e3:.2f} mm{fitted}",
            soft_wrap=True,
            highlight=False,
        )

    call(command, "calibrate export", arguments)
