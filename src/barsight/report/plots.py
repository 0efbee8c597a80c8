"""Build the page's interactive plots as plotly.js figures: plain data, coloured by the page's script.

A colour that starts with `--` is the name of a CSS variable of page.css.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.linalg.robust import SIGMAS_95
from barsight.core.records.heights import Contour, HeightSource
from barsight.core.records.sensor_samples import LaserProfile
from barsight.mapping.agreement import profile_difference

MAX_POINTS, MAX_SCATTER = 20_000, 3_000
"""Maximum numbers of samples that a line and a cloud of markers show."""
SERIES = ("--series-0", "--series-1", "--series-2", "--series-3", "--series-4", "--series-5")
Trace = dict[str, Any]


@dataclass(frozen=True)
class Picture:
    """A picture for the page: `name` is its id, `uri` its data, `caption` explains it."""

    name: str
    title: str
    caption: str
    uri: str


@dataclass(frozen=True, eq=False)
class Plot:
    """A figure: `name` is its id on the page, `height_px` its height, `caption` explains how to read it."""

    name: str
    traces: list[Trace]
    layout: dict[str, Any]
    height_px: int
    caption: str = ""


@dataclass(frozen=True, eq=False)
class ComparedContour:
    """A contour, the laser profile beside it if there is one, and vision minus laser at its points (m)."""

    contour: Contour
    laser: LaserProfile | None
    error_m: Float64


def pair_with_laser(
    contours: tuple[Contour, ...], laser: tuple[LaserProfile, ...]
) -> tuple[ComparedContour, ...]:
    """Pair each contour with the laser profile of the same number."""
    by_number = {profile.profile: profile for profile in laser}
    return tuple(
        ComparedContour(c, by_number[c.profile], profile_difference(c, by_number[c.profile]))
        if c.profile in by_number
        else ComparedContour(c, None, np.empty(0))
        for c in contours
    )


def json_numbers(values: Float64, decimals: int) -> list[float | None]:
    """Round for the page; a value that isn't finite becomes None, which interrupts a line."""
    return [float(v) if np.isfinite(v) else None for v in np.round(values, decimals)]


def keep_extremes(values: Float64, max_count: int) -> Int64:
    """Thin to at most `max_count` samples that draw the same line: the minimum and maximum of each bin."""
    count = values.size
    if count <= max_count:
        return np.arange(count)
    bins = max_count // 2
    edges = np.linspace(0, count, bins + 1).astype(np.int64)
    width = int(np.diff(edges).max())
    index = edges[:-1, None] + np.arange(width)
    inside = index < edges[1:, None]
    sample = np.where(inside, values[index.clip(0, count - 1)], np.nan)
    low = np.where(np.isnan(sample), np.inf, sample).argmin(axis=1)
    high = np.where(np.isnan(sample), -np.inf, sample).argmax(axis=1)
    return np.unique(np.concatenate([edges[:-1] + low, edges[:-1] + high]))


def contour_plot(compared: ComparedContour) -> Plot:
    """Plot heights along X with their band and the laser's; below, the difference if there is a laser."""
    contour, laser = compared.contour, compared.laser
    kept = keep_extremes(contour.z_m, MAX_POINTS)
    x, z, sigma = contour.x_m[kept], contour.z_m[kept] * 1e3, contour.sigma_m[kept] * 1e3
    source = contour.source[kept]
    seen = np.where(HeightSource.measured(source), z, np.nan)
    name = "vision and laser" if (source == HeightSource.LASER).any() else "vision"
    traces = [_band(x, seen, SIGMAS_95 * sigma), line_trace(name, x, seen, "--series-0", 1.4)]
    filled = source == HeightSource.FILLED
    if filled.any():
        traces.append(_markers("filled", x[filled], z[filled], "--filled", 5))
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": "x / m"}},
        "yaxis": {"title": {"text": "height / mm"}},
    }
    caption = f"Profile {contour.profile}. The band is {name} ± {SIGMAS_95} sigma; unknown places are gaps."
    if kept.size < contour.x_m.size:
        caption += f" The plot shows the extremes of {contour.x_m.size} samples; contour.csv has them all."
    if laser is None:
        return Plot(f"contour-{contour.profile}", traces, layout, 340, caption)
    of_laser = keep_extremes(laser.z_m, MAX_POINTS)
    traces.append(line_trace("laser", laser.x_m[of_laser], laser.z_m[of_laser] * 1e3, "--laser", 1.2))
    error = compared.error_m * 1e3
    of_error = keep_extremes(error, MAX_POINTS)
    shown = line_trace("vision − laser", laser.x_m[of_error], error[of_error], "--series-1", 1.2)
    traces.append({**shown, "yaxis": "y2"})
    known = np.abs(error[np.isfinite(error)])
    reach = max(20.0, _reach(known))
    margin = 0.02 * float(np.ptp(laser.x_m)) + 0.05
    first, last = float(laser.x_m.min()) - margin, float(laser.x_m.max()) + margin
    layout["xaxis"] |= {"anchor": "y2", "range": [first, last]}
    layout["yaxis"]["domain"] = [0.42, 1.0]
    layout["yaxis2"] = {
        "domain": [0.0, 0.32],
        "title": {"text": "vision − laser / mm"},
        "range": [-reach, reach],
        "zeroline": True,
    }
    outside = int((known > reach).sum())
    if outside:
        caption += f" {outside} differences lie outside the lower axis' first range; zoom out to see them."
    return Plot(f"contour-{contour.profile}", traces, layout, 560, caption)


def histogram_plot(compared: tuple[ComparedContour, ...]) -> Plot | None:
    """Plot the frequency of differences, a step line per profile; None without a difference."""
    errors = {c.contour.profile: c.error_m[np.isfinite(c.error_m)] * 1e3 for c in compared}
    together = np.abs(np.concatenate([*errors.values(), np.empty(0)]))
    if together.size == 0:
        return None
    reach = max(10.0, _reach(together))
    bin_mm = next(side for side in (1, 2, 5, 10, 20, 50, 100, 1e9) if 2 * reach / side <= 80)
    reach = (np.ceil(reach / bin_mm) + 0.5) * bin_mm
    edges = np.arange(-reach, reach + bin_mm / 2, bin_mm)
    traces = []
    for order, (profile, error) in enumerate(errors.items()):
        share = 100 * np.histogram(error, edges)[0] / max(error.size, 1)
        trace = line_trace(
            f"profile {profile}", edges[:-1] + bin_mm / 2, share, SERIES[order % len(SERIES)], 1.6
        )
        trace["line"]["shape"] = "hvh"
        traces.append(trace)
    outside = int((together > reach).sum())
    layout = {
        "xaxis": {"title": {"text": "vision − laser / mm"}, "zeroline": True},
        "yaxis": {"title": {"text": "share of samples / %"}, "rangemode": "tozero"},
    }
    caption = f"Bins of {bin_mm:g} mm; {outside} of {together.size} differences lie beyond ± {reach:g} mm."
    return Plot("histogram", traces, layout, 340, caption)


def limits_plot(compared: tuple[ComparedContour, ...], agreement: list[dict[str, Any]]) -> Plot | None:
    """Plot difference over mean height, bias, 95 % limits of agreement [Bland 1986]; None without laser."""
    traces: list[Trace] = []
    shapes: list[dict[str, Any]] = []
    rows = {row.get("profile"): row for row in agreement}
    draw = np.random.default_rng(0)
    decimated = False
    for order, item in enumerate(compared):
        if item.laser is None or not np.isfinite(item.error_m).any():
            continue
        colour = SERIES[order % len(SERIES)]
        known = np.flatnonzero(np.isfinite(item.error_m))
        if known.size > MAX_SCATTER:
            known, decimated = np.sort(draw.choice(known, MAX_SCATTER, replace=False)), True
        error = item.error_m[known] * 1e3
        mean = item.laser.z_m[known] * 1e3 + error / 2
        traces.append(_markers(f"profile {item.contour.profile}", mean, error, colour, 3))
        row = rows.get(item.contour.profile, {})
        for key, dash in (("bias_mm", "solid"), ("loa_low_mm", "dash"), ("loa_high_mm", "dash")):
            if row.get(key) is not None:
                shapes.append(_level(float(row[key]), colour, dash))
    if not traces:
        return None
    layout = {
        "xaxis": {"title": {"text": "mean of vision and laser / mm"}},
        "yaxis": {"title": {"text": "vision − laser / mm"}, "zeroline": True},
        "shapes": shapes,
    }
    caption = (
        f"Solid lines: bias; dashed lines: 95 % limits of agreement (bias ± {SIGMAS_95} standard deviations)."
    )
    if decimated:
        caption += f" {MAX_SCATTER} samples of each profile, drawn at random."
    return Plot("limits", traces, layout, 340, caption)


def _reach(sizes: Float64) -> float:
    """Estimate the extent of most sizes: almost four sigma of a normal distribution, robust."""
    return 3 * float(np.percentile(sizes, 80)) if sizes.size else 0.0


def _band(x: Float64, z: Float64, half: Float64) -> Trace:
    """Draw the band as one closed polygon for each run of known samples, so that gaps stay open."""
    known = np.isfinite(z) & np.isfinite(half)
    steps = np.diff(np.concatenate([[0], known.astype(np.int8), [0]]))
    gap = np.array([np.nan])
    outline_x: list[Float64] = []
    outline_z: list[Float64] = []
    for first, last in zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1), strict=True):
        run = slice(first, last)
        outline_x += [x[run], x[run][::-1], gap]
        outline_z += [(z + half)[run], (z - half)[run][::-1], gap]
    return {
        "type": "scatter",
        "mode": "lines",
        "name": f"± {SIGMAS_95} sigma",
        "x": json_numbers(np.concatenate([*outline_x, np.empty(0)]), 4),
        "y": json_numbers(np.concatenate([*outline_z, np.empty(0)]), 1),
        "fill": "toself",
        "fillcolor": "--band",
        "line": {"width": 0, "color": "--band"},
        "hoverinfo": "skip",
    }


def line_trace(
    name: str, x: Float64, y: Float64, colour: str, width: float, decimals: tuple[int, int] = (4, 2)
) -> Trace:
    """Make a line. decimals: of x and y."""
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": json_numbers(x, decimals[0]),
        "y": json_numbers(y, decimals[1]),
        "line": {"color": colour, "width": width},
    }


def time_plot(name: str, title: str, traces: list[Trace], caption: str) -> Plot:
    """Plot traces over time in seconds. title: of the other axis."""
    layout = {"xaxis": {"title": {"text": "time / s"}}, "yaxis": {"title": {"text": title}}}
    return Plot(name, traces, layout, 300, caption)


def _markers(name: str, x: Float64, y: Float64, colour: str, size: float) -> Trace:
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": json_numbers(x, 4),
        "y": json_numbers(y, 2),
        "marker": {"color": colour, "size": size, "opacity": 0.6},
    }


def _level(y: float, colour: str, dash: str) -> dict[str, Any]:
    line = {"color": colour, "dash": dash, "width": 1.2}
    return {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": y, "y1": y, "line": line}
