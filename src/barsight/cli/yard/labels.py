"""Run `barsight labels RECORDING OUT`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from pathlib import Path

import tyro
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.labels.reading import ReadLabels, read_labels, write_labels
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from barsight.yard.inventory.stock_list import read_stock
from barsight.yard.label_settings import LabelSettings


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, read the labels and write them."""

    def command(
        recording: tyro.conf.Positional[Path],
        out: tyro.conf.Positional[Path],
        stock_list: Path | None = None,
        label_m: tuple[float, float] = LabelSettings().size_m,
        numbers: bool = False,
        reading: tyro.conf.OmitArgPrefixes[RecordingSettings] = RecordingSettings(),  # noqa: B008
    ) -> None:
        """Read the codes on labels in a recording's pictures, and assign them to the bundles of its result.

        OUT/labels.json lists each text with its kind, its place, the number of pictures in which it was
        read, and its bundle. DataMatrix, QR, Aztec, PDF417, Code 128 and Code 93 are read if their own
        checksum is right; a label is certain if at least two pictures agree. A module must be about two
        pixels wide.

        Args:
            recording: The recording that OUT was measured from.
            out: A folder of results from barsight measure; labels.json is written to it.
            stock_list: CSV or JSON as for bundles.stock_list; labels that contradict it are reported.
            label_m: Length and width of a label in metres. A bright plate of this size on a bundle that no
                picture reads is reported as illegible; 0 0 disables the search.
            numbers: Read plain numbers too, where no code is read (extra `numbers`, and Tesseract's
                English data).
            reading: How to read the recording.
        """
        listed = () if stock_list is None else read_stock(stock_list)
        source = open_recording(recording, reading)
        settings = LabelSettings(read=True, numbers=numbers, size_m=label_m)
        total, done = (1 + numbers) * len(source.index.stamps_ns), count(1)
        console = SafeConsole()
        with stages(SafeConsole(stderr=True)) as advance:
            found = read_labels(source, out, listed, settings, lambda: advance("labels", next(done), total))
        target = write_labels(found, out)
        _print(found, console)
        console.print_line(f"labels: {target}")

    call(command, "labels", arguments)


def _print(found: ReadLabels, console: SafeConsole) -> None:
    table = Table("text", "kind", "x m", "y m", "pictures", "bundle", "", box=SIMPLE_HEAD)
    for one in found.labels:
        verdict = "sure" if one.is_sure else "; ".join(one.doubts)
        bundle = "-" if one.bundle is None else str(one.bundle)
        x, y = (f"{value:.2f}" for value in one.place_m[:2])
        table.add_row(escape(one.text), one.kind, x, y, str(one.pictures), bundle, escape(verdict))
    console.print(table if found.labels else f"no label was read in {found.pictures} pictures")
    if found.illegible:
        console.print(f"illegible: the labels on bundles {', '.join(map(str, found.illegible))}")
    for text in found.contradictions:
        console.print(f"[yellow]{escape(text)}[/yellow]", soft_wrap=True, highlight=False)
