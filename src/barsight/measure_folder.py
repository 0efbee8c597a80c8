"""Measure a recording into a folder of result files."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from barsight.core.compiling.ahead import compile_ahead
from barsight.core.errors import ConfigError, OutputError
from barsight.core.files import atomic_directory, lies_within
from barsight.core.json_values import write_json
from barsight.core.parallel import in_background
from barsight.core.settings.values import expect_choice
from barsight.core.timing import ProgressCallback
from barsight.evaluation.score import score_folder
from barsight.mapping.surface.surface import read_tile
from barsight.measure_settings import MeasureSettings
from barsight.pipeline.lift_choice import LiftRequest, find_lifts
from barsight.pipeline.mapped_yard import map_yard
from barsight.recording.base import Recording
from barsight.recording.open import open_recording
from barsight.report.files.result_files import RESULT_FILES, write_results, write_surface, write_tables
from barsight.report.files.summary import summary
from barsight.report.page import write_report
from barsight.result_folder import seal_map
from barsight.yard.events import events_beside, kept_events, merged


def ignore_progress(stage: str, done: int, total: int) -> None:
    """Ignore progress; the default callback."""


def measure_into(
    paths: Path | Sequence[Path],
    out: Path,
    settings: MeasureSettings,
    *,
    advance: ProgressCallback = ignore_progress,
    overwrite: bool = False,
    resume: bool = False,
    truth_of: Path | None = None,
    magnet: Path | None = None,
    judged_at: Literal["now", "end"] = "now",
    report: bool = True,
) -> dict[str, Any]:
    """Measure, write all files and, if requested, the report into `out`; return the content of result.json.

    paths: a recording, or several passes over one yard, which become one map. resume: keep completed work in
    `.NAME.resume` beside `out`, and continue from what is there. truth_of: a recording with ground truth to
    evaluate against, only after measuring. judged_at: time at which lifts are judged, see
    `barsight.pipeline.lift_choice.LiftRequest`.
    """
    expect_choice("at", judged_at, ("now", "end"))
    chosen = [paths] if isinstance(paths, Path) else list(paths)
    if not chosen:
        raise ConfigError("no recording is named: give one, or several passes over one yard")
    for path in chosen:
        if lies_within(out, path):
            raise OutputError(f"{out}: lies in the recording itself; name a folder elsewhere")
    keep = out.absolute().with_name(f".{out.absolute().name}.resume") if resume else None
    request = LiftRequest.of(magnet, judged_at)
    content = write_measured(
        [open_recording(path, settings.recording) for path in chosen], out, settings, request,
        advance=advance, overwrite=overwrite, keep=keep, truth_of=truth_of, report=report,
    )  # fmt: skip
    if keep is not None:
        shutil.rmtree(keep, ignore_errors=True)
    return content


def write_measured(
    recordings: Sequence[Recording],
    out: Path,
    settings: MeasureSettings,
    request: LiftRequest,
    *,
    advance: ProgressCallback = ignore_progress,
    overwrite: bool = False,
    keep: Path | None = None,
    truth_of: Path | None = None,
    report: bool = True,
) -> dict[str, Any]:
    """Measure open recordings; see `measure_into`. keep: a folder of checkpoints to continue from.

    Events that were reported in `out`, or beside it in `request.surveys`, and that the new map may not show
    are kept.
    """
    with atomic_directory(out, replace=overwrite, owned=RESULT_FILES) as staging:
        scratch = staging / "scratch"
        scratch.mkdir()
        compile_ahead(advance, "measure")
        mapped = map_yard(recordings, settings, scratch, advance, keep)
        with in_background(
            lambda: write_surface(
                mapped.surface, mapped.free, mapped.tops, staging, mapped.frame_id, mapped.history
            )
        ):
            beside = () if request.surveys is None else events_beside(request.surveys)
            measured = find_lifts(mapped, replace(request, events=merged(kept_events(out), beside)))
        content = summary(measured)
        write_tables(measured, staging)
        write_results(measured, seal_map(content, staging), staging)
        shutil.rmtree(scratch)
        read_tile.cache_clear()  # frees 60 MB of tiles that no longer exist
        if truth_of is not None:
            content["truth"] = score_folder(truth_of, staging)
        write_json(staging / "result.json", content)
        if report:
            write_report(staging, staging / "report.html")
    return content
