"""Run `barsight info RECORDING`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from barsight.cli.arguments import by_own_flags, call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import InputError
from barsight.recording.base import RecordingSettings
from barsight.recording.formats.bag_file import Topic
from barsight.recording.info import describe_recording
from barsight.recording.info_tables import print_info
from barsight.recording.open import bag_at, open_recording


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and print the content of the recording."""

    def command(
        recording: tyro.conf.Positional[Path],
        settings: Annotated[RecordingSettings, tyro.conf.arg(name="")] = RecordingSettings(),  # noqa: B008
    ) -> None:
        """List the content of a recording: sensors, rates, gaps, dropped pictures and why, calibration.

        For a bag without a calibration, the topics are listed.

        Args:
            recording: The recording.
            settings: How to read the recording.
        """
        console = SafeConsole()
        try:
            opened = open_recording(recording, settings)
        except InputError as error:
            bag = bag_at(recording)
            if bag is None or settings != RecordingSettings():
                raise by_own_flags(error) from None
            print_topics(bag.topics, bag.duration_s, console)
            note = str(by_own_flags(error))
            console.print(f"[yellow]note:[/yellow] {escape(note)}", soft_wrap=True, highlight=False)
            return
        print_info(describe_recording(opened), console)

    call(command, "info", arguments)


def print_topics(topics: Sequence[Topic], duration_s: float, console: Console) -> None:
    """Print the content of a bag by topic; rates are means over the bag's duration."""
    table = Table(title=f"Topics, {duration_s:.2f} s", title_justify="left")
    for name in ("topic", "type"):
        table.add_column(name, overflow="fold")
    for name in ("messages", "rate (Hz)"):
        table.add_column(name, justify="right")
    for topic in topics:
        rate = f"{(topic.count - 1) / duration_s:.2f}" if topic.count > 1 and duration_s > 0 else "-"
        table.add_row(escape(topic.name), escape(topic.kind), str(topic.count), rate)
    console.print(table)
