"""Run `barsight disparity LEFT RIGHT -o FILE`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.markup import escape

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError, OutputError
from barsight.core.files import atomic_paths
from barsight.core.records.disparity import Disparity
from barsight.measurement import Preview
from barsight.reconstruction.pair_matching import match_pictures
from barsight.report.files.result_files import write_preview
from barsight.stereo.disparity_files import write_calib, write_disparity
from barsight.stereo.settings import StereoSettings

_POOR = "warning: hardly anything is matched well: two pictures of one pair, bright and sharp enough?"
_POOR_SIGMA_PX = 0.7
"""Lower quartile (px) of the method's own sigma above which a poor match is reported. Sound pairs
(Middlebury, EuRoC, KITTI, a yard) have 0.06 to 0.45; noise, pictures of different scenes and pictures drowned
in noise have 1.0 to 42.
"""
SUFFIXES = (".pfm", ".png", ".tif", ".tiff")


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and match the pair."""

    def command(
        left: tyro.conf.Positional[Path],
        right: tyro.conf.Positional[Path],
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        rig: Path | None = None,
        range: str | None = None,
        preview: Path | None = None,
        settings: Annotated[StereoSettings, tyro.conf.arg(name="")] = StereoSettings(),  # noqa: B008
    ) -> None:
        """Match one pair; a .tif holds the left picture's disparity, in pixels, and its sigma per pixel.

        Args:
            left: The left picture, rectified unless a rig is given. Colour and 16 bits are converted to gray,
                although `csca` uses the colours too.
            right: The right picture.
            out: The file to write: .pfm, .png (16 bits, disparity times 256) or .tif (disparity and sigma).
            rig: Rig file (Barsight's, Kalibr's, OpenCV's) or EuRoC folder; the pictures are then raw and are
                rectified. Focal length, baseline and doffs are written next to FILE as NAME_calib.txt
                (Middlebury's format).
            range: Disparity candidates A:B in px; by default they are found from the pictures.
            preview: PNG to write with the left picture next to the disparity in colours.
            settings: The method and its settings.
        """
        console = SafeConsole(stderr=True)
        if out.suffix.lower() not in SUFFIXES:
            raise OutputError(f"{out}: disparities are written as {', '.join(SUFFIXES)}")
        _expect_own((out, preview), (left, right, rig))
        if range is not None:
            low, high = _parsed_range(range)
            settings = replace(settings, min_disparity_px=low, max_disparity_px=high)
        pair, disparity = match_pictures(left, right, settings, rig)
        with_rig = () if rig is None else (out.with_name(f"{out.stem}_calib.txt"),)
        with atomic_paths(out, *with_rig) as (path, *calib):
            write_disparity(path, disparity)
            for beside in calib:
                write_calib(beside, pair.camera)
            if preview is not None:
                write_preview(Preview(pair.left, disparity.disparity_px), preview)
        console.print(_summary(out, disparity), soft_wrap=True, highlight=False)
        if settings.method == "barsight" and np.nanpercentile(disparity.sigma_px, 25) > _POOR_SIGMA_PX:
            console.print(_POOR, soft_wrap=True, highlight=False)

    call(command, "disparity", arguments)


def _expect_own(outputs: tuple[Path, Path | None], inputs: tuple[Path | None, ...]) -> None:
    """Raise OutputError for an output that is one of the inputs, or the other one, which it would replace."""
    taken = {path.resolve(): "an input of this command" for path in inputs if path is not None}
    for path in outputs:
        if path is None:
            continue
        if (what := taken.get(path.resolve())) is not None:
            raise OutputError(f"{path}: is {what}; name another file")
        taken[path.resolve()] = "the disparity's file"


def _summary(out: Path, disparity: Disparity) -> str:
    found = disparity.disparity_px[np.isfinite(disparity.disparity_px)]
    return (
        f"{escape(str(out))}: {100 * disparity.coverage:.1f} % of the pixels, {found.min():.2f} to "
        f"{found.max():.2f} px, median sigma {np.nanmedian(disparity.sigma_px):.3f} px"
    )


def _parsed_range(text: str) -> tuple[int, int]:
    try:
        low, high = (int(part) for part in text.split(":"))
    except ValueError as error:
        raise ConfigError(f"--range takes A:B in whole pixels, not {text!r}") from error
    return low, high
