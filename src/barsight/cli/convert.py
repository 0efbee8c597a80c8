"""Run `barsight convert RECORDING -o OUT --to FORMAT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from barsight.cli.arguments import by_own_flags, call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import InputError
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from barsight.recording.writers.convert import Target, convert


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and convert."""

    def command(
        recording: tyro.conf.Positional[Path],
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        to: Target,
        settings: Annotated[RecordingSettings, tyro.conf.arg(name="")] = RecordingSettings(),  # noqa: B008
    ) -> None:
        """Write a recording in another format; pictures, stamps and numbers stay unchanged.

        Args:
            recording: The recording to read.
            out: The folder to write; it must not exist yet.
            to: The format to write.
            settings: How to read the recording.
        """
        console = SafeConsole(stderr=True)
        try:
            source = open_recording(recording, settings)
        except InputError as error:
            raise by_own_flags(error) from None
        with stages(console) as advance:
            done = convert(source, out, to, lambda n, total: advance("pictures", n, total))
        text = f"{done.images} pictures written to {done.out}"
        console.print_line(text)
        if done.left_out:
            console.print(f"[yellow]{done.left_out} pictures were missing or torn and are left out[/yellow]")

    call(command, "convert", arguments)
