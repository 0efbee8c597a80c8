"""Run `barsight info RECORDING`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.recording.base import RecordingSettings
from barsight.recording.info import describe_recording
from barsight.recording.info_tables import print_info
from barsight.recording.open import open_recording


def run(arguments: Sequence[str]) -> None:
    """Parse and print."""

    def command(
        recording: tyro.conf.Positional[Path],
        settings: Annotated[RecordingSettings, tyro.conf.arg(name="")] = RecordingSettings(),  # noqa: B008
    ) -> None:
        """Say what is in a recording: sensors, rates, gaps, dropped pictures and why, calibration.

        Args:
            recording: The recording.
            settings: How to read it.
        """
        print_info(describe_recording(open_recording(recording, settings)), SafeConsole())

    call(command, "info", arguments)
