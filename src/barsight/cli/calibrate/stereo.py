"""Run `barsight calibrate stereo PICTURES --board BOARD -o rig.yaml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape

from barsight.board_views import MIN_VIEWS, views_from_detections, views_from_pictures
from barsight.calibration.boards.board import parse_board
from barsight.calibration.boards.detection_files import has_detections
from barsight.calibration.geometry.projection import Lens
from barsight.calibration.stereo.calibration import StereoCalibration, calibrate_stereo
from barsight.calibration.stereo.verdict import (
    MAX_RANGE_M,
    MIN_RANGE_M,
    Verdict,
    assess,
    expect_usable,
    summary_sentence,
)
from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.files import atomic_paths, expect_output
from barsight.report.calibration.stereo_page import write_calibration_report

COLOURS = {Verdict.GOOD: "green", Verdict.USABLE: "yellow", Verdict.REDO: "red"}


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and calibrate."""

    def command(
        pictures: tyro.conf.Positional[Path],
        board: str,
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        lens: tyro.conf.EnumChoicesFromValues[Lens] = Lens.RADTAN4,
        range_m: float = 7.0,
        max_views: int = 150,
        resolution: str | None = None,
    ) -> None:
        """Calibrate two cameras from pictures of a board that both see.

        The exit code is 5 if the verdict is redo; the files are written all the same.

        Args:
            pictures: Folder of pictures in pairs (folders left and right, or left01.png and right01.png), an
                EuRoC recording, a bag, or a folder of detections (cam0_detections.npz, cam1_detections.npz).
            board: checkerboard:9x6:0.025 (inner corners, square in m), charuco:11x8:0.03:0.022[:DICTIONARY]
                (squares, square and marker in m) or aprilgrid:6x6:0.088:0.3 (tags, tag in m, gap per tag).
            out: The rig file to write (.yaml); its report goes next to it (.html and .json).
            lens: The lens model. More coefficients need board corners near the pictures' corners.
            range_m: Range, in metres, at which the rig will measure; the verdict judges the depth there.
            max_views: Maximum number of views; a longer film is thinned evenly.
            resolution: WIDTHxHEIGHT of the cameras, required for detections, which do not contain it.
        """
        _expect(out, range_m, max_views)
        console = SafeConsole(stderr=True)
        target = parse_board(board)
        if pictures.is_dir() and has_detections(pictures):
            views, sizes, left_out = views_from_detections(pictures, target, max_views, resolution)
        else:
            with stages(console) as advance:
                views, sizes, left_out = views_from_pictures(pictures, target, max_views, advance)
        calibration = calibrate_stereo(views, target, lens, sizes, pictures, left_out)
        assessment = assess(calibration, range_m)
        html, data = out.with_suffix(".html"), out.with_suffix(".json")
        with atomic_paths(out, html, data) as (path, *report):
            calibration.save(path)
            write_calibration_report(calibration, assessment, *report)
        _print(console, calibration, out, html)
        colour = COLOURS[assessment.verdict]
        console.print(f"[{colour}]{assessment.verdict}[/{colour}]: {summary_sentence(assessment.lines)}")
        for sentence in assessment.advice:
            console.print(f"  {sentence}", highlight=False)
        expect_usable(assessment.lines, out)

    call(command, "calibrate stereo", arguments)


def _expect(out: Path, range_m: float, max_views: int) -> None:
    expect_output(out, ".yaml", ".yml")
    if not MIN_RANGE_M <= range_m <= MAX_RANGE_M:
        raise ConfigError(f"--range-m {range_m:g} can't be; give the working distance in metres")
    if max_views < MIN_VIEWS:
        raise ConfigError(f"--max-views {max_views} is too few; give {MIN_VIEWS} or more")


def _print(console: Console, calibration: StereoCalibration, out: Path, html: Path) -> None:
    for entry in calibration.removed[:20]:
        line = escape(f"{entry.view} {entry.camera}: {entry.reason}")
        console.print(f"[yellow]{line}[/yellow]", soft_wrap=True, highlight=False)
    if len(calibration.removed) > 20:
        console.print(f"[yellow]... and {len(calibration.removed) - 20} more, all in the report[/yellow]")
    console.print(
        f"{escape(str(out))}: {len(calibration.views)} views, {calibration.rms_px:.3f} px RMS, baseline "
        f"{calibration.rig.baseline_m * 1e3:.2f} ± {calibration.baseline_sigma_m * 1e3:.2f} mm; report "
        f"{escape(str(html))}",
        soft_wrap=True, highlight=False,
    )  # fmt: skip
    console.print(f"board: {calibration.shape}", soft_wrap=True, highlight=False)
