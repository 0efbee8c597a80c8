"""Write the page about the paper: every entry with its pictures and tables, in one file."""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import barsight
from barsight.benchmarks.provenance import provenance
from barsight.benchmarks.stereo.target_size import TargetSizeBench
from barsight.core.errors import BarsightError, InputError
from barsight.core.files import atomic_directory
from barsight.core.timing import ProgressCallback
from barsight.paper import cloud, findings, published, runs, surface
from barsight.paper.architecture import Architecture, measure_architecture
from barsight.paper.checks import rotation_errors_deg
from barsight.paper.features import (
    FilteredMatches,
    TwoViews,
    draw_features,
    draw_pairs,
    feature_rows,
    two_views,
)
from barsight.paper.icp import IcpScore, icp_score
from barsight.paper.pictures import PaperPicture
from barsight.paper.registry import ENTRIES, FURTHER
from barsight.recording.open import open_recording
from barsight.report.page import environment, resource
from barsight.simulation.settings.rig import CameraSettings

Cells = list[list[str]]
_OF_PAPER = ("SGBM", "CSCA", "its own")
_NAMES = {"barsight": "ours"}


@dataclass(frozen=True)
class PaperTable:
    """A table of the page: headers, rows of cells, and a note below."""

    heads: tuple[str, ...]
    rows: Cells
    note: str = ""


@dataclass(frozen=True)
class PageContent:
    """Pictures, tables and findings by the id of their entry; further tables with their titles."""

    pictures: dict[str, list[PaperPicture]]
    tables: dict[str, PaperTable]
    findings: dict[str, str]
    further: list[tuple[str, PaperTable]]


def write_paper(out: Path, advance: ProgressCallback, *, quick: bool, recording: Path | None) -> None:
    """Run everything and write OUT/paper.html, completely or not at all."""
    scale = runs.QUICK if quick else runs.FULL
    began, cpu = time.perf_counter(), time.process_time()
    with atomic_directory(out) as folder, tempfile.TemporaryDirectory() as scratch_name:
        content = _content(scale, Path(scratch_name), recording, advance)
        made = {
            "scale": "quick" if quick else "full", "source": "drawn" if recording is None else recording.name,
            "commit": provenance().commit, "version": barsight.__version__,
            "wall_s": time.perf_counter() - began, "cpu_s": time.process_time() - cpu,
            "length_m": scale.length_m, "frames": scale.frames, "size_px": scale.size_px,
        }  # fmt: skip
        page = environment().get_template("paper_page.html.jinja").render(
            entries=ENTRIES, content=content, css=resource("page.css"), made=made,
        )  # fmt: skip
        (folder / "paper.html").write_text(page, encoding="utf-8")


def _content(
    scale: runs.PaperScale, scratch: Path, recording: Path | None, advance: ProgressCallback
) -> PageContent:
    top = recording or runs.draw(scratch / "top", scale.recording(), "draw top", advance)
    side = runs.draw(scratch / "side", scale.side(), "draw side", advance)
    source = open_recording(top)
    pictures: dict[str, list[PaperPicture]] = {}
    views = {"side": two_views(open_recording(side)), "top": two_views(source)}
    found = {where: feature_rows(views[where]) for where in views}
    _feature_pictures(views, found, pictures)
    depth_errors = _surface_pictures(views["top"], pictures)
    paper, drift = runs.trajectories(source)
    pictures["figure-10"] = list(cloud.stitched_pair(cloud.view_clouds(source, paper, 3)))
    icp = icp_score(source, paper, scale.icp_steps)
    results = _results(top, scratch, advance)
    _map_pictures(scratch, results, pictures)
    advance("target size", 0, 1)
    sizes = runs.target_sizes(scale)
    advance("target size", 1, 1)
    tables = {
        "table-1": _table_1(sizes), "table-2": _table_2(found), "table-3": _table_3(found),
        "table-4": _table_4(scratch, results, source.rig.cam0.fx_px),
        "figure-6": _architecture(measure_architecture(source, paper)), "figure-7": _steps(found),
        "equation-20": _rotations(), "conclusion-1": _drift(drift),
    }  # fmt: skip
    further = [("Environments", _environments(runs.environment_rows(scale, scratch, advance)))]
    further.append(("What has no number", PaperTable(("what", "command"), [list(row) for row in FURTHER])))
    if icp is not None:
        further.append(("Section 4.3: ICP after the stitching", _icp(icp)))
    said = {
        "conclusion-1": findings.of_drift(drift), "conclusion-2": findings.of_depth(depth_errors),
        "conclusion-3": findings.of_matches([*found["side"], *found["top"]]),
        "conclusion-4": findings.of_results(results),
        "conclusion-5": findings.of_bundles(scratch, results, top),
    }  # fmt: skip
    return PageContent(pictures, tables, said, further)


def _results(
    recording: Path, scratch: Path, advance: ProgressCallback
) -> dict[str, dict[str, Any] | BarsightError]:
    """Measure the recording by the paper's method and by ours, into folders of these names."""
    has_truth = (recording / "truth" / "height.npz").is_file()
    return {
        method: runs.measure(
            recording, scratch / method, settings, with_truth=has_truth, stage=method, advance=advance
        )
        for method, settings in (("paper", runs.PAPER), ("ours", runs.OURS))
    }


def _feature_pictures(
    views: dict[str, TwoViews], found: dict[str, tuple[FilteredMatches, ...]],
    pictures: dict[str, list[PaperPicture]],
) -> None:  # fmt: skip
    for where, rows in found.items():
        view = views[where]
        final = "figure-8" if where == "side" else "figure-9"
        pictures.setdefault("figure-4", []).extend(draw_features(view, row, where) for row in rows)
        pictures.setdefault("figure-5", []).extend(
            draw_pairs(view, row, where, filtered=False) for row in rows
        )
        pictures[final] = [draw_pairs(view, row, where, filtered=True) for row in rows]


def _surface_pictures(view: TwoViews, pictures: dict[str, list[PaperPicture]]) -> dict[str, float]:
    """Draw the figures about stereo; returns the median error of each depth, mm."""
    pair = view.old.pair
    disparities = surface.match_three(pair)
    if not disparities:
        return {}
    depths = surface.depth_maps(pair, disparities)
    errors = surface.depth_errors_mm(depths, view.true_depth_m)
    pictures["figure-1"] = [surface.cost_curve(pair, disparities["paper"])]
    pictures["figure-2"] = list(surface.loop_pictures(disparities))
    pictures["figure-3"] = list(surface.relief_pictures(pair, depths, errors))
    return errors


def _map_pictures(
    scratch: Path, results: dict[str, dict[str, Any] | BarsightError], pictures: dict[str, list[PaperPicture]]
) -> None:
    for method, result in results.items():
        if isinstance(result, BarsightError):
            continue
        named = f"by {method}" if method == "ours" else "by the paper's method"
        pictures.setdefault("figure-11", []).append(cloud.map_picture(scratch / method, named))
        contour = cloud.contour_picture(scratch / method, named)
        if contour is not None:
            pictures.setdefault("figure-12", []).append(contour)


def _number(value: float, decimals: int = 1, unit: str = "") -> str:
    return f"{value:.{decimals}f}{unit}" if math.isfinite(value) else "–"


def _table_1(sizes: TargetSizeBench) -> PaperTable:
    heads = ("range mm", *(f"paper: {name} mm, %" for name in _OF_PAPER),
             *(f"here: {_NAMES.get(one.method, one.method)} %" for one in sizes.methods))  # fmt: skip
    rows = []
    measured = {one.range_mm: k for k, one in enumerate(sizes.methods[0].ranges)}
    for range_mm, *printed in published.TARGET_SIZE:
        row = [str(range_mm)]
        for size, error in zip(printed[::2], printed[1::2], strict=True):
            right = published.recomputed(size)
            wrong = f" (printed {error:.2f})" if abs(right - error) > 0.02 else ""
            row.append(f"{size:.3f}, {right:.2f}{wrong}")
        k = measured.get(range_mm)
        row += ["–" if k is None else _number(m.ranges[k].size.mean_abs_pct, 2) for m in sizes.methods]
        rows.append(row)
    bars = "one drawn bar" if sizes.poses == 1 else f"{sizes.poses} drawn bars"
    note = (
        f"The paper's errors are recomputed from its sizes. Here: mean error of {bars} of 90 mm at each "
        "range, by the crane's camera of 1250 px and 0.5 m; the paper names neither its camera nor how it "
        "measures."
    )
    return PaperTable(heads, rows, note)


def _table_2(found: dict[str, tuple[FilteredMatches, ...]]) -> PaperTable:
    heads = ("type", "paper side", "ms", "here side", "ms", "paper top", "ms", "here top", "ms")
    rows = []
    for k, row in enumerate(found["side"]):
        side, side_ms, top, top_ms = published.FEATURES[row.detector]
        other = found["top"][k]
        rows.append([
            row.detector.upper(), str(side), str(side_ms), str(len(row.places)), _number(row.detect_ms, 0),
            str(top), str(top_ms), str(len(other.places)), _number(other.detect_ms, 0),
        ])  # fmt: skip
    note = (
        "Here at most 2000 features are asked for; other pictures, another machine. The paper's 500 of ORB "
        "is the number that OpenCV stops at unless told otherwise."
    )
    return PaperTable(heads, rows, note)


def _table_3(found: dict[str, tuple[FilteredMatches, ...]]) -> PaperTable:
    heads = ("type", "surface", "paper: initial", "filtered", "ms", "here: initial", "filtered", "ms",
             "true before %", "true after Eq. 7 %", "true after %")  # fmt: skip
    rows = []
    for where, first in (("side", 0), ("top", 3)):
        for row in found[where]:
            printed = [str(value) for value in published.MATCHES[row.detector][first : first + 3]]
            own = [str(int(row.initial.sum())), str(int(row.kept.sum())), _number(row.total_ms, 0)]
            shares = [_number(share) for share in (row.true_before, row.true_plane, row.true_after)]
            rows.append([row.detector.upper(), where, *printed, *own, *shares])
    note = (
        "True: within 2 px of where true depth and poses take the feature. The paper's SURF has more initial "
        "matches on the top (69) than features there (36, its Table 2)."
    )
    return PaperTable(heads, rows, note)


def _table_4(
    scratch: Path, results: dict[str, dict[str, Any] | BarsightError], focal_px: float
) -> PaperTable:
    heads = ("method", "MAE mm", "MRE", "largest mm", "largest relative", "dimension", "method", "spacing mm",
             "Hz", "MAE against truth mm")  # fmt: skip
    rows = [["paper: laser", *published.LASER, "–"], ["paper: vision", *published.VISION, "–"]]
    for method, result in results.items():
        if isinstance(result, BarsightError):
            rows.append([f"here: {method}", str(result), *["–"] * 8])
            continue
        score = cloud.contour_scores(scratch / method)
        truth = result.get("truth", {}).get("contour, smooth places", {}).get("mae_mm", math.nan)
        hertz = result["frames"]["used"] / result["seconds"]
        spacing = f"{1e3 * CameraSettings().above_floor_m / focal_px:.1f}"
        figures = ["–"] * 4
        if score is not None:
            figures = [
                _number(score.mae_mm, 2), " / ".join(_number(v, 2, " %") for v in score.relative_pct),
                _number(score.max_mm), " / ".join(_number(v, 2, " %") for v in score.max_relative_pct),
            ]  # fmt: skip
        rows.append(
            [f"here: {method}", *figures, "3D", "face scan", spacing, _number(hertz, 2), _number(truth)]
        )
    note = (
        "Relative errors here: against the paper's 3.77 m, and against the stack's own height. Spacing: one "
        "pixel at the floor, 8 m away. Hz: pairs a second of the whole pipeline, map included, beside what "
        "else this machine did. Against the laser both contours are filtered and all samples count, steps "
        "and gullies too; against truth, smooth places."
    )
    return PaperTable(heads, rows, note)


def _architecture(measured: Architecture | None) -> PaperTable:
    heads = ("part", "gives", "off truth")
    if measured is None:
        return PaperTable(heads, [], "Without truth and an IMU nothing can be said.")
    way = f"{measured.way_m:.1f} m in {measured.seconds:.0f} s"
    rows = [
        ["IMU alone (Eq. 9-11)", f"the way from start to end, {way}",
         _number(1e3 * measured.alone_m, 1, " mm")],
        ["IMU, its velocity held by the pictures", "the trend from frame to frame",
         _number(measured.trend_mm, 1, " mm a step")],
        ["pictures: matches that the trend leaves (Eq. 6, 7, 12), SVD (Eq. 13-20)",
         "the pose of the frame, which holds the velocity", _number(measured.stitched_mm, 1, " mm a step")],
    ]  # fmt: skip
    return PaperTable(heads, rows, f"Lengths, RMS over {measured.steps} steps.")


def _steps(found: dict[str, tuple[FilteredMatches, ...]]) -> PaperTable:
    rows = [
        [row.detector.upper(), where, str(len(row.places)), str(int(row.initial.sum())),
         str(int(row.on_plane.sum())), str(int(row.kept.sum()))]
        for where, group in found.items() for row in group
    ]  # fmt: skip
    heads = (
        "type",
        "surface",
        "features",
        "mutual (Eq. 6)",
        "on the homography (Eq. 7)",
        "on the trend (Eq. 12)",
    )
    return PaperTable(heads, rows)


def _rotations() -> PaperTable:
    printed, right = rotation_errors_deg()
    rows = [["as printed, U V^T", f"{printed:.3f}"], ["corrected, V diag(1, 1, det) U^T", f"{right:.3f}"]]
    return PaperTable(("form", "off a known turn of 10 degrees, degrees"), rows)


def _drift(drift: list[cloud.DriftRow]) -> PaperTable:
    rows = [
        [row.what, f"{row.placed} of {row.frames}", _number(row.rmse_mm), _number(row.turn_deg, 3),
         _number(row.drift_pct, 3)]
        for row in drift
    ]  # fmt: skip
    note = "RMSE after the best rigid motion; drift over all stretches of 5 m and more [Geiger 2012]."
    return PaperTable(("estimate", "frames placed", "RMSE mm", "RMSE deg", "drift %"), rows, note)


def _environments(rows: list[runs.EnvironmentRow]) -> PaperTable:
    cells = [
        [row.name, row.method, row.frames, _number(row.mae_mm), _number(row.coverage_pct), row.failed]
        for row in rows
    ]  # fmt: skip
    heads = ("degradation", "method", "frames placed", "contour MAE mm", "seen %", "failed")
    return PaperTable(heads, cells, "A stack of 3 m, 8 pairs; against truth, on smooth places.")


def _icp(score: IcpScore) -> PaperTable:
    rows = [["as stitched (Eq. 13-20)", _number(score.stitched_mm)], ["after ICP", _number(score.refined_mm)]]
    verdict = "helps here" if score.refined_mm < score.stitched_mm else "makes the steps worse"
    note = (
        f"Point to plane over the overlapping clouds, {score.steps} steps: it {verdict}. Bars look alike all "
        "along, so it is no stage of the pipeline."
    )
    return PaperTable(("step's length against truth", "RMS mm"), rows, note)


def expect_recording(path: Path | None) -> None:
    """Check that the recording exists. Raises InputError otherwise."""
    if path is not None and not path.exists():
        raise InputError(path, "no such recording", "name a recording, or leave --recording out")
