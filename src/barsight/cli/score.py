"""Run `barsight score RECORDING OUT`."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from barsight.cli.arguments import call
from barsight.evaluation.score import score_folder


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and compare."""

    def command(recording: tyro.conf.Positional[Path], out: tyro.conf.Positional[Path]) -> None:
        """Compare a measured yard with the truth of its simulated recording; prints JSON.

        Args:
            recording: The recording, with its folder truth.
            out: The folder of results from barsight measure for it.
        """
        json.dump(score_folder(recording, out), sys.stdout, indent=1)
        sys.stdout.write("\n")

    call(command, "score", arguments)
