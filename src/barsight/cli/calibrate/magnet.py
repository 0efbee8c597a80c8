"""Run `barsight calibrate magnet CERTIFICATE --magnet FILE -o FILE`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import tyro

from barsight.acceptance.budgets.touch_downs import touched_offset
from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import InputError
from barsight.core.files import atomic_path, expect_output
from barsight.yard.magnet.description import load_magnet


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, average the touch-downs and write the magnet's file."""

    def command(
        certificate: tyro.conf.Positional[Path],
        magnet: Path,
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
    ) -> None:
        """Find the magnet's offset from where the crane's readings place it, from touch-downs.

        The magnet's file is written again with the mean of the touch-downs and its sigma as [offset]. With
        it, each lift gives the readings at which the magnet's centre is over the target (crane_target). The
        offset holds at the yaw of the touch-downs; at any yaw where they were made at several.

        Args:
            certificate: Certificate from barsight accept with touch-downs on at least three spheres or dummy
                bundles.
            magnet: TOML file of the magnet, without an [offset].
            out: The .toml file to write.
        """
        expect_output(out, ".toml")
        described = load_magnet(magnet)
        if described.offset is not None:
            raise InputError(magnet, "has an [offset] already", "give the file without it")
        offset = touched_offset(certificate, described.tolerance)
        lines = [f"{name} = {_value(value)}" for name, value in asdict(offset).items() if value is not None]
        with atomic_path(out) as path:
            text = magnet.read_text("utf-8").rstrip("\n")
            path.write_text("\n".join([text, "", "[offset]", *lines, ""]), encoding="utf-8")
        SafeConsole().print(f"offset: {offset.words}", highlight=False)

    call(command, "calibrate magnet", arguments)


def _value(value: object) -> str:
    return f"{value:.5f}" if isinstance(value, float) else json.dumps(value)
