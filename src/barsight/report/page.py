"""Write the report page: one self-contained HTML file from the files of a measured folder."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from plotly.offline import get_plotlyjs

from barsight.core.errors import InputError
from barsight.core.files import atomic_path, atomic_paths
from barsight.core.parallel import in_background
from barsight.report.map_images import preview_uri, read_raster
from barsight.report.page_maps import MapFigure, map_figures
from barsight.report.page_trajectory import path_plots
from barsight.report.page_yard import yard_part, yard_pictures
from barsight.report.plots import Picture, Plot, contour_plot, histogram_plot, limits_plot, pair_with_laser
from barsight.result_folder import open_folder, read_contours, read_laser, read_path

NONE = "–"
TRUTH_HEADS = {
    "samples": "samples", "coverage_pct": "coverage / %", "bias_mm": "bias / mm", "median_mm": "median / mm",
    "mae_mm": "MAE / mm", "p95_mm": "P95 / mm", "max_mm": "max / mm",
    "within_95_pct": "within the stated 95 % / %",
}  # fmt: skip
"""Quantities compared with the ground truth, with their column headings."""


@dataclass(frozen=True)
class KeyFigure:
    """A key figure at the top of the page: name, value with unit, and a note in small print."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True, eq=False)
class PagePictures:
    """Pictures of the height map, and those for bundles and lifts; none without height.tif."""

    maps: tuple[MapFigure, ...] = ()
    yard: tuple[MapFigure, ...] = ()


def draw_pictures(out_dir: Path) -> PagePictures:
    """Draw the parts of the page that don't depend on the lifts and take longest. Raises InputError like
    `write_report`.
    """
    height = out_dir / "height.tif"
    if not height.is_file():
        return PagePictures()
    raster = read_raster(height)
    with in_background(lambda: yard_pictures(out_dir, raster)) as yard:
        maps = map_figures(raster, read_laser(out_dir))
    return PagePictures(maps, yard.result())


def write_report(out_dir: Path, target: Path, pictures: PagePictures | None = None) -> None:
    """Write the page of the folder `out_dir` to `target`, completely or not at all.

    pictures: those of the folder, if already drawn. result.json is required; a section whose file is missing
    says so in a sentence. Raises InputError for a missing or damaged file, OutputError if `target` can't be
    written.
    """
    page = render_page(out_dir, pictures)
    with atomic_path(target) as path:
        # A path may contain bytes that aren't text; the page shows a question mark for them.
        path.write_text(page, encoding="utf-8", errors="replace")


def write_summary_page(
    template: str,
    summary: dict[str, Any],
    figures: list[KeyFigure],
    plots: list[Plot],
    html: Path,
    data: Path,
    pictures: Sequence[Picture] = (),
) -> None:
    """Write a page of key figures and plots to `html`, and its summary as JSON to `data`, both or neither.

    The template finds the plots in `plots`, by name, and the pictures in `pictures`.
    """
    page = environment().get_template(template).render(
        summary=summary, figures=figures, plots={plot.name: plot for plot in plots},
        plot_data=plot_json(plots), plotly_js=get_plotlyjs(), css=resource("page.css"),
        script=resource("page_script.js.jinja"), pictures=pictures,
    )  # fmt: skip
    with atomic_paths(html, data) as (page_path, data_path):
        page_path.write_text(page, encoding="utf-8", errors="replace")
        data_path.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def render_page(out_dir: Path, pictures: PagePictures | None = None) -> str:
    """Render the page's HTML; see `write_report`."""
    result, _ = open_folder(out_dir)
    laser = read_laser(out_dir)
    compared = pair_with_laser(read_contours(out_dir), laser)
    path = read_path(out_dir)
    drawn = pictures or draw_pictures(out_dir)
    contours = [contour_plot(item) for item in compared]
    agreement = [
        found
        for found in (histogram_plot(compared), limits_plot(compared, result.get("agreement") or []))
        if found is not None
    ]
    ways = path_plots(path, str(result.get("reference", "world"))) if path else ()
    return _filled(
        out_dir,
        result=result,
        figures=key_figures(result),
        maps=drawn.maps,
        yard=yard_part(out_dir, drawn.yard),
        contours=contours,
        agreement_plots=agreement,
        ways=ways,
        plot_data=plot_json([*contours, *agreement, *ways]),
        has_laser=bool(laser),
        stages=_stages(result),
        refused_by_stage=_refused_by_stage(result),
        configuration=list(flatten(result.get("configuration") or {})),
        truth=_truth_table(result.get("truth") or {}),
        preview=preview_uri(out_dir / "preview.png"),
        plotly_js=get_plotlyjs(),
        css=resource("page.css"),
        script=resource("page_script.js.jinja"),
    )


def _filled(out_dir: Path, **content: Any) -> str:
    """Fill in the page. Raises InputError if result.json lacks required content."""
    try:
        return environment().get_template("page.html.jinja").render(**content)
    except jinja2.UndefinedError as error:
        path = out_dir / "result.json"
        raise InputError(
            path, f"lacks what the report shows ({error.message})", "measure it again"
        ) from error


def key_figures(result: dict[str, Any]) -> list[KeyFigure]:
    """Select the figures that an operator needs first."""
    frames = result.get("frames") or {}
    trajectory = result.get("trajectory") or {}
    surface = result.get("map") or {}
    unused = f"{len(frames.get('refused') or [])} refused"
    if passed_over := (frames.get("passed_over") or {}).get("count"):
        unused += f", {passed_over} hardly moved"
    figures = [
        KeyFigure("Frames used", f"{frames.get('used', NONE)} of {frames.get('total', NONE)}", unused),
        KeyFigure(
            "Travel",
            format_number(trajectory.get("length_m"), 2, "m"),
            format_number(trajectory.get("duration_s"), 1, "s"),
        ),
    ]
    for row in result.get("agreement") or []:
        everywhere = f"{format_number(row.get('mae_mm'), 1, 'mm')} with steps and gullies"
        note = f"{everywhere}, coverage {format_number(row.get('coverage_pct'), 1, '%')}"
        label = f"MAE to laser, smooth places, profile {row.get('profile')}"
        figures.append(KeyFigure(label, format_number(row.get("smooth_mae_mm"), 1, "mm"), note))
    cells = {key: surface.get(f"cells_{key}") or 0 for key in ("seen", "filled", "unknown")}
    total = sum(cells.values())
    share = {key: 100 * count / total if total else math.nan for key, count in cells.items()}
    note = (
        f"filled {format_number(share['filled'], 1, '%')}, unknown {format_number(share['unknown'], 1, '%')}"
    )
    figures.append(KeyFigure("Map seen", format_number(share["seen"], 1, "%"), note))
    sigma = surface.get("median_sigma_m")
    cell = surface.get("cell_m")
    figures.append(
        KeyFigure(
            "Median sigma",
            format_number(None if sigma is None else sigma * 1e3, 1, "mm"),
            f"cells of {format_number(None if cell is None else cell * 1e3, 0, 'mm')}",
        )
    )
    each = (
        f"{format_number((result.get('seconds') or 0.0) / max(frames.get('used') or 1, 1), 2, 's')} per frame"
    )
    figures.append(KeyFigure("Time to measure", format_number(result.get("seconds"), 1, "s"), each))
    figures.append(KeyFigure("Peak memory", format_number(result.get("peak_memory_mib"), 0, "MiB")))
    return figures


def format_number(value: Any, decimals: int = 1, unit: str = "") -> str:
    """Format a number for people, with narrow spaces between thousands and the unit; a dash for none."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return NONE
    text = f"{value:,.{decimals}f}".replace(",", "\u202f").replace("-", "−")
    return f"{text}\u00a0{unit}" if unit else text


def format_value(value: Any) -> str:
    """Format any value of result.json in one line."""
    if isinstance(value, float):
        return f"{value:.6g}"
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def flatten(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Flatten nested settings to dotted names with their values."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", format_value(value)


def _truth_table(truth: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Arrange the comparison with the truth: a row for each kind of place, a column for each quantity."""
    kept = {key: head for key, head in TRUTH_HEADS.items() if any(key in row for row in truth.values())}
    rows = [
        (place, [format_number(figures.get(key), int(key != "samples")) for key in kept])
        for place, figures in truth.items()
    ]
    return {"heads": tuple(kept.values()), "rows": rows} if rows else {}


def _stages(result: dict[str, Any]) -> list[dict[str, Any]]:
    """List the stages with their share of the total time (%) and, for stages by frame, seconds per frame."""
    stages = result.get("stages") or []
    whole = sum(stage.get("seconds") or 0.0 for stage in stages)
    rows = []
    for stage in stages:
        seconds, frames = stage.get("seconds") or 0.0, stage.get("frames") or 0
        share = 100 * seconds / whole if whole else 0.0
        each = seconds / frames if frames else None
        name = stage.get("name", NONE)
        rows.append({"name": name, "seconds": seconds, "frames": frames, "each": each, "share": share})
    return rows


def _refused_by_stage(result: dict[str, Any]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for refused in (result.get("frames") or {}).get("refused") or []:
        stage = str(refused.get("stage", NONE))
        counts[stage] = counts.get(stage, 0) + 1
    return counts


def plot_json(plots: list[Plot]) -> str:
    """Serialize all figures for the script; `<` is escaped so that no text can end the enclosing element."""
    figures = {plot.name: {"data": plot.traces, "layout": plot.layout} for plot in plots}
    return json.dumps(figures, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def environment() -> jinja2.Environment:
    """Make the environment of the templates: escaping, the package's own files, number formats."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(resource),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = format_number
    environment.filters["plain"] = format_value
    return environment


def resource(name: str) -> str:
    """Read the text of one of this package's files."""
    return resources.files("barsight.report").joinpath("templates", name).read_text(encoding="utf-8")
