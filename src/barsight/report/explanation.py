"""Explain a lift: each check with its value and bound, and a picture of the place."""

from __future__ import annotations

import base64
import math
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cattrs
import cv2
import numpy as np

from barsight.core.arrays import Float64, UInt8
from barsight.core.errors import ConfigError
from barsight.core.files import atomic_path
from barsight.report.page import environment, format_number, resource
from barsight.result_folder import changed_inputs, open_folder, read_heights
from barsight.yard.axes import corners
from barsight.yard.events import kept_events
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.lift_file import forbidden_since, read_lifts, read_unseen
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.magnet.holding import over_map_m
from barsight.yard.map_lookup import lookup_heights
from barsight.yard.placement.clearance import HIGHEST_OBJECT, FacePlane, find_obstacle
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, HeightMap, YardMap
from barsight.yard.vetoes import Veto

PIXELS_PER_M = 180.0
"""Scale of the picture."""
BEYOND_M = 0.5
"""Margin in metres shown around the magnet."""
LOW_M, HIGH_M = -0.3, 0.1
"""Range in metres of the colour scale, relative to the faces' plane."""
BGR = {
    "face": (180, 47, 255), "beam": (255, 255, 255), "tolerance": (0, 215, 255), "bundle": (83, 211, 57),
    "offending": (30, 30, 230), "no-lift": (0, 128, 255), "stanchion": (255, 255, 0),
}  # fmt: skip
UNSEEN_BGR, HATCH_BGR = (225, 225, 225), (150, 150, 150)


@dataclass(frozen=True, eq=False)
class Explanation:
    """A lift of lifts.json with the findings of its checks.

    title: in words. picture: (H, W, 3) BGR, None if nothing was known under the magnet. map_vetoes: what
    forbids every lift of the map; since: what has forbidden this lift since it was offered. unseen: what
    would show what was not seen of a refused lift, empty if nothing is known that would.
    """

    title: str
    record: dict[str, Any]
    map_vetoes: tuple[dict[str, str], ...]
    picture: UInt8 | None
    is_simulated: bool
    since: tuple[Veto, ...] = ()
    unseen: str = ""

    @property
    def checks(self) -> list[dict[str, Any]]:
        """Return the checks, those that forbid first."""
        order = {"failed": 0, "unknown": 1, "passed": 2}
        return sorted(self.record["checks"], key=lambda check: order[check["result"]])


def explain(folder: Path, which: str) -> Explanation:
    """Explain the lift `which` of a folder: `3` is the offered lift of rank 3, `bundle:12` the offered or
    refused lift of bundle 12.

    Raises ConfigError if there is no such lift, InputError if the folder can't be read.
    """
    summary, _ = open_folder(folder)
    lifts = read_lifts(folder / "lifts.json")
    record = _find(lifts, which, folder)
    ids = ", ".join(str(number) for number in record["bundles"]) or "no bundle"
    rank, bundles = record["rank"], read_bundles(folder / "bundles.json")
    since: tuple[Veto, ...] = ()
    state = "is refused"
    if rank is not None:
        state = f"is offered at rank {rank}"
        if lifts["looks_back"]:
            state = f"would have been offered at rank {rank} at the recording's end"
        else:
            since = forbidden_since(lifts, record, bundles, kept_events(folder), time.time_ns())
            if changed := changed_inputs(summary):
                since = (*since, Veto("calibration-changed", f"{changed} was changed since: measure again"))
        if since:
            state = f"was offered at rank {rank}, and is forbidden now: {', '.join(v.code for v in since)}"
    picture = None
    if record["target"]["z_m"] is not None:
        magnet = cattrs.structure(lifts["magnet"], Magnet)
        settings = cattrs.structure(lifts["settings"], LiftSettings)
        picture = draw_place(read_heights(folder), record, magnet, bundles, settings)
    title = f"The lift of bundle {ids} {state}"
    simulated = bool(summary.get("is_simulated"))
    places = read_unseen(lifts) if rank is None else None
    unseen = places.sentence_for(record["bundles"]) if places else ""
    return Explanation(title, record, tuple(lifts["vetoes"]), picture, simulated, since, unseen)


def _find(lifts: dict[str, Any], which: str, folder: Path) -> dict[str, Any]:
    match = re.fullmatch(r"(bundle:)?(\d+)", which)
    if match is None:
        raise ConfigError(f"{which!r} names no lift; give a rank like 3, or a bundle like bundle:12")
    number = int(match[2])
    every: list[dict[str, Any]] = [*lifts["lifts"], *lifts["refused"]]
    for record in every:
        if number in record["bundles"] if match[1] else number == record["rank"]:
            return record
    if match[1]:
        known = sorted({k for record in every for k in record["bundles"]})
        listed = f"it judges those of {', '.join(str(k) for k in known)}" if known else "it judges none"
        raise ConfigError(f"{folder}: lifts.json has no lift of bundle {number}; {listed}")
    raise ConfigError(
        f"{folder}: no lift of rank {number} is offered; there are {len(lifts['lifts'])}. A refused one is "
        "named by its bundle, like bundle:12"
    )


def format_check(check: dict[str, Any]) -> tuple[str, str]:
    """Format a check's value with sigma, and its bound."""
    unit = "°" if check["unit"] == "deg" else check["unit"]
    decimals = {"mm": 1, "N": 0, "kg": 0, "s": 0, "": 3, "deg": 2}.get(check["unit"], 2)
    if float(check["value"] or 0).is_integer() and float(check["bound"] or 0).is_integer():
        decimals = 0
    figure, bound = (format_number(check[name], decimals) for name in ("value", "bound"))
    if check["sigma"]:
        figure += f" ± {format_number(check['sigma'], decimals)}"
    return f"{figure} {unit}".strip("– "), f"{bound} {unit}".strip("– ")


def write_explanation(told: Explanation, target: Path) -> None:
    """Write the page as one file, completely or not at all."""
    rows = [{**check, "figure": figure, "limit": limit} for check in told.checks
            for figure, limit in [format_check(check)]]  # fmt: skip
    picture = None
    if told.picture is not None:
        encoded = cv2.imencode(".png", told.picture)[1].tobytes()
        picture = f"data:image/png;base64,{base64.b64encode(encoded).decode('ascii')}"
    colours = {name: f"rgb({r}, {g}, {b})" for name, (b, g, r) in BGR.items()}
    page = environment().get_template("explanation_page.html.jinja").render(
        told=told, rows=rows, picture=picture, colours=colours, css=resource("page.css")
    )  # fmt: skip
    with atomic_path(target) as path:
        path.write_text(page, encoding="utf-8")


def draw_place(
    heights: YardMap, record: dict[str, Any], magnet: Magnet, bundles: tuple[Bundle, ...],
    settings: LiftSettings,
) -> UInt8:  # fmt: skip
    """Draw the heights around a lift (H, W, 3), with the beam from left to right, faces, tolerance, bundles,
    the offending cells, and the stanchions and no-lift areas of the settings.
    """
    target = record["target"]
    place = Placement(target["x_m"], target["y_m"], math.radians(target["yaw_deg"]))
    long = max(magnet.half_span_m, magnet.beam.length_m / 2) + BEYOND_M
    wide = max(magnet.beam.width_m / 2, *(abs(p.across_m) + p.width_m / 2 for p in magnet.poles)) + BEYOND_M
    reach = math.hypot(long, wide) * np.array([-1, 1])
    part = part_about(heights, place.x_m + reach, place.y_m + reach)
    sigma_mm = next(check["sigma"] for check in record["checks"] if check["what"] == HIGHEST_OBJECT)
    load = tuple(bundle for bundle in bundles if bundle.id in record["bundles"])
    faces = FacePlane(
        target["z_m"] - over_map_m(load, settings.strap_m)[0], math.radians(record["pitch_deg"]),
        math.radians(record["roll_deg"]), sigma_mm / 1e3,
    )  # fmt: skip
    picture = _paint(part, place, faces, long, wide)

    def pixels(xy_m: Float64) -> Float64:
        away = xy_m - (place.x_m, place.y_m)
        along, across = away @ place.along, away @ place.across
        return np.stack([(along + long) * PIXELS_PER_M, (across + wide) * PIXELS_PER_M], axis=-1)

    obstacle = find_obstacle(place, part, magnet, faces, load)
    if obstacle is not None:
        half = math.ceil(0.005 * PIXELS_PER_M)
        for x, y in np.round(pixels(obstacle.places_m)).astype(int):
            cv2.rectangle(picture, (x - half, y - half), (x + half, y + half), BGR["offending"], -1)

    def outline(corners_m: Float64, kind: str, thickness: int = 2) -> None:
        points = np.round(pixels(corners_m)).astype(np.int32)
        cv2.polylines(picture, [points], True, BGR[kind], thickness, cv2.LINE_AA)

    for bundle in bundles:
        outline(bundle.corners_m, "bundle")
        middle = np.round(pixels(bundle.centre_m[None, :2]))[0].astype(int).tolist()
        cv2.putText(picture, str(bundle.id), middle, cv2.FONT_HERSHEY_SIMPLEX, 0.6, BGR["bundle"], 2)
    for low_x, low_y, high_x, high_y in settings.no_lift_areas:
        outline(np.array([(low_x, low_y), (high_x, low_y), (high_x, high_y), (low_x, high_y)]), "no-lift", 3)
    for x, y, _ in settings.stanchions:
        at = np.round(pixels(np.array([[x, y]]))).astype(int)[0].tolist()
        cv2.drawMarker(picture, at, BGR["stanchion"], cv2.MARKER_DIAMOND, 16, 3)
    centre = np.array([place.x_m, place.y_m])
    outline(corners(centre, place.yaw_rad, magnet.beam.width_m, magnet.beam.length_m), "beam")
    more_v, more_u = 2 * magnet.tolerance.along(place.beam_axes)
    for pole in magnet.poles:
        at = centre + pole.along_m * place.along + pole.across_m * place.across
        size = pole.width_m, pole.length_m
        outline(corners(at, place.yaw_rad, size[0] + more_u, size[1] + more_v), "tolerance", 1)
        outline(corners(at, place.yaw_rad, *size), "face")
    return picture


def _paint(heights: HeightMap, place: Placement, faces: FacePlane, long: float, wide: float) -> UInt8:
    """Paint the heights above the faces' plane in colours, unseen cells hatched."""
    v = np.arange(-long, long, 1 / PIXELS_PER_M)
    u = np.arange(-wide, wide, 1 / PIXELS_PER_M)
    vv, uu = np.meshgrid(v, u)
    x, y = (
        centre + vv * along + uu * across
        for centre, along, across in zip((place.x_m, place.y_m), place.along, place.across, strict=True)
    )
    plane = faces.centre_z_m + vv * math.tan(faces.pitch_rad) + uu * math.tan(faces.roll_rad)
    rise = lookup_heights(heights, x, y) - plane
    level = np.clip((np.nan_to_num(rise, nan=LOW_M) - LOW_M) / (HIGH_M - LOW_M), 0, 1)
    picture = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    rows, columns = np.indices(rise.shape)
    hatch = (rows + columns) // 4 % 3 == 0
    unseen = np.isnan(rise)
    picture[unseen] = UNSEEN_BGR
    picture[unseen & hatch] = HATCH_BGR
    return np.ascontiguousarray(picture, dtype=np.uint8)
