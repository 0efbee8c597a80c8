"""Collect the error sources of a measured bundle from its folder, yard file and certificate."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from barsight.acceptance.budgets.budget import BudgetedLoad, ErrorSource
from barsight.acceptance.budgets.touch_downs import touch_errors_m
from barsight.acceptance.certificate import read_certificate
from barsight.acceptance.observation import ViewGeometry, view_geometry
from barsight.acceptance.yard_area import measured_rig
from barsight.core.arrays import Float64
from barsight.core.errors import ConfigError, InputError, MeasurementError
from barsight.core.pose import Pose, skew
from barsight.registration.yard_file import YardFrame, read_yard_file
from barsight.result_folder import open_folder, read_heights
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.description import MAX_TURN_DEG, MagnetOffset
from barsight.yard.types import Bundle, YardMap
from barsight.yard.weight import bundle_mass
from barsight.yard_frame import shared_covariance

REMEDY = "measure the recording again"
MAX_SIGMA_RATIO = 0.1
"""Maximum plausible sigma of yaw (rad), baseline and focal length (ratios); above it, the file is refused."""
SHAPE = "shape of the bundle"
"""Name of the error source for how far a bundle's shape may differ from its fitted outline. A dummy
bundle's shape is known, so this source is left out for it.
"""
EXPANSION_PER_K = 23e-6
"""Thermal expansion (1/K) of the aluminium bar that carries the cameras."""


@dataclass(frozen=True, eq=False)
class MeasuredLoad:
    """A measured bundle with all inputs of its budget.

    origin_m: point about which the yard frame's errors rotate. assumed: sentences on assumptions that nobody
    verified. targets_m: (T, 3) from which this rig found the yard frame; None where it didn't.
    """

    bundle: int
    load: BudgetedLoad
    view: ViewGeometry
    origin_m: Float64
    sources: tuple[ErrorSource, ...]
    assumed: tuple[str, ...]
    targets_m: Float64 | None


def measured_load(
    folder: Path, number: int | None, certificate: Path | None, temperature_k: float,
    offset: MagnetOffset | None = None,
) -> MeasuredLoad:  # fmt: skip
    """Collect the error sources of a bundle.

    number: its id; None for the bundle with the highest confidence. temperature_k: largest change since the
    calibration. offset: of the magnet, subtracted from the crane's target; without it, the certificate's
    touch-down errors count in full.

    Raises InputError, ConfigError where the folder has no such bundle, MeasurementError where it has none.
    """
    summary, _ = open_folder(folder, lifts=False)
    if summary["reference"] != "yard":
        raise InputError(folder, "isn't in the yard's frame", "measure with encoders, or with --yard")
    if certificate is not None:
        told = read_certificate(certificate)
        _expect_own(certificate, told, summary)
        if offset is None and told.get("magnet_offset") is not None:
            raise InputError(certificate, "was made with a magnet's offset", "give --magnet with that offset")
    if offset is not None:
        _expect_own(folder / "result.json", summary, asdict(offset), "the magnet's offset")
    bundle = _chosen(folder, number)
    view = view_geometry(folder, measured_rig(summary))
    heights = read_heights(folder)
    assumed: list[str] = []
    change = temperature_k * EXPANSION_PER_K / 3**0.5
    sources = [
        _rig_source(summary, folder / "result.json", view.focal_px, assumed),
        ErrorSource(
            "temperature of the rig", ("baseline",), np.array([[change**2]]),
            f"up to {temperature_k:g} K of aluminium", "rectangular",
        ),
        *fit_sources(bundle, heights, _shared_m(summary, folder / "result.json")),
    ]  # fmt: skip
    frame, travel = _yard_frame(summary), Travel.read(summary)
    if travel is None:
        raise InputError(folder / "result.json", "doesn't say how sure the travel is", REMEDY)
    near = np.linalg.norm(travel.place_m - bundle.centre_m[:2], axis=1) < travel.reach_m
    seen_from = np.append(
        travel.place_m[near].mean(axis=0) if near.any() else bundle.centre_m[:2], view.camera_m[2]
    )
    below = np.append(seen_from[:2], bundle.top_z_m)
    shared = np.zeros((6, 6)) if frame is None else frame_covariance(frame, seen_from, below)
    sources += [*_frame_source(frame, shared, assumed), _travel_source(travel.sigma_m[near], shared)]
    if offset is None:
        sources += _magnet_source(certificate, assumed)
    else:
        sources += _offset_sources(offset, offset.beam_yaw(bundle.yaw_rad), assumed)
    mass = bundle_mass(bundle)
    top = np.array([bundle.centre_m[0], bundle.centre_m[1], bundle.top_z_m])
    load = BudgetedLoad(top, bundle.yaw_rad, bundle.length_m, bundle.width_m, mass.kg)
    targets = None
    if frame is not None and frame.attitude is None and frame.calibration_id is not None:
        targets = frame.targets_m
    return MeasuredLoad(bundle.id, load, view, below, tuple(sources), tuple(assumed), targets)


def _expect_own(path: Path, stated: dict[str, Any], other: dict[str, Any], whose: str = "the folder") -> None:
    """Raise InputError where a file belongs to another rig or yard frame than the data it is used with."""
    for name in ("calibration_id", "yard_frame_id"):
        if stated.get(name) != other.get(name):
            what = name.removesuffix("_id").replace("_", " ")
            problem = f"is of another {what} ({stated.get(name)}; {whose} has {other.get(name)})"
            raise InputError(path, problem, "accept this rig in this yard frame, and touch down with it")


def _rig_source(summary: dict[str, Any], path: Path, focal_px: float, assumed: list[str]) -> ErrorSource:
    """Form the rig's source from the uncertainty left by rig file and travel, or else from the assumed
    settings.
    """
    name, stated = "calibration of the cameras", summary.get("rig_uncertainty")
    try:
        if stated is not None:
            sigma = np.array(
                [np.radians(stated["yaw_deg"]), stated["baseline_ratio"], stated["focal_ratio"]], float
            )
            covariance = np.outer(sigma, sigma) * np.array(stated["correlation"], float).reshape(3, 3)
        else:
            sigma_px = float(summary["configuration"]["stereo"]["calibration_sigma_px"])
            covariance = np.array([[(sigma_px / focal_px) ** 2]])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(path, "doesn't say how sure the rig's calibration is", REMEDY) from error
    if not (np.isfinite(covariance).all() and (np.diag(covariance) <= MAX_SIGMA_RATIO**2).all()):
        raise InputError(path, "what it says of the rig's calibration is impossible", REMEDY)
    if stated is not None:
        by = "the rig file's covariance, and the travel"
        return ErrorSource(name, ("yaw", "baseline", "focal"), covariance, by)
    assumed.append("no rig file with a covariance was used: baseline and focal length count as exact")
    return ErrorSource(name, ("yaw",), covariance, "stereo.calibration_sigma_px")


def _chosen(folder: Path, number: int | None) -> Bundle:
    bundles = read_bundles(folder / "bundles.json")
    if not bundles:
        raise MeasurementError(f"{folder}: no bundle was found there; nothing can be budgeted")
    if number is not None:
        listed = ", ".join(str(one.id) for one in bundles)
        bundles = tuple(one for one in bundles if one.id == number)
        if not bundles:
            raise ConfigError(f"{folder}: there is no bundle {number}; bundles.json has {listed}")
    return max(bundles, key=lambda one: (not any(one.ends_open), one.confidence))


def fit_sources(
    bundle: Bundle, heights: YardMap, shared_m: tuple[float, float] = (0.0, 0.0)
) -> list[ErrorSource]:
    """Form the sources of matching and fit from the bundle's file and the map.

    shared_m: part of its lateral and top sigmas due to errors common to all its heights, which is subtracted.
    """
    row = round((bundle.centre_m[1] - heights.y0_m) / heights.cell_m)
    column = round((bundle.centre_m[0] - heights.x0_m) / heights.cell_m)
    part = heights.part(
        slice(max(row - 5, 0), min(row + 6, heights.shape[0])),
        slice(max(column - 5, 0), min(column + 6, heights.shape[1])),
    )
    known = np.isfinite(part.sigma_m)
    views = float(np.median(part.views[known])) if known.any() else 1.0
    cell_m = float(np.median(part.sigma_m[known])) if known.any() else nan
    sigma, fit, free = bundle.sigma, bundle.fit_sigma or bundle.sigma, max(views - 1, 1.0)
    sigmas = {
        "fit_along": (sigma.along_m, fit.along_m, 0.0),
        "fit_across": (sigma.lateral_m, fit.lateral_m, shared_m[0]),
        "fit_top": (sigma.top_z_m, fit.top_z_m, shared_m[1]),
        "fit_yaw": (sigma.yaw_rad, fit.yaw_rad, 0.0), "fit_width": (sigma.width_m, fit.width_m, 0.0),
    }  # fmt: skip
    mass_kg = bundle_mass(bundle).sigma_kg
    sources = [_fit_source("fit_mass", mass_kg**2, free)]
    for name, (whole, alone, shared) in sigmas.items():
        own = alone**2 if np.isnan(alone) else max(alone**2 - shared**2, 0.0)
        sources.append(_fit_source(name, own, free))
        rest = whole**2 - alone**2
        if rest > 0:
            by = "bundles.json: sigma over fit_sigma"
            sources.append(ErrorSource(SHAPE, (name,), np.array([[rest]]), by))
    cell = np.array([[cell_m**2]])
    return [*sources, ErrorSource("noise of a cell", ("fit_height",), cell, "height.tif", "t", free)]


def _fit_source(name: str, variance: float, free: float) -> ErrorSource:
    covariance = np.array([[variance]])
    return ErrorSource("matching and fit", (name,), covariance, "bundles.json", "t", free)


def _shared_m(summary: dict[str, Any], path: Path) -> tuple[float, float]:
    """Read the assumed sigmas of errors common to all heights of a bundle, lateral and vertical."""
    try:
        settings = summary["configuration"]["bundles"]
        return float(settings["shared_lateral_m"]), float(settings["shared_height_m"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(path, "doesn't say bundles.shared_lateral_m and shared_height_m", REMEDY) from error


def frame_covariance(frame: YardFrame, seen_from: Float64, below: Float64) -> Float64:
    """Compute the covariance (6, 6) of the rotation and translation that the yard frame causes about a place
    (3,), seen from the body at `seen_from` (3,), both in the yard. It includes the effect of a bend; where
    only the attitude is taken from the frame, its own place is left out.
    """
    carry = np.eye(6)
    carry[3:, :3] = -skew(below - seen_from)
    shared = shared_covariance(Pose("yard", "body", np.eye(3), seen_from), frame)
    covariance: Float64 = carry @ shared @ carry.T
    return covariance


def _travel_source(sigma_m: Float64, shared: Float64) -> ErrorSource:
    """Form the travel's source from the trajectory's covariance near the bundle, without the yard frame's
    part.

    sigma_m: (N, 3) there; shared: (6, 6) from `frame_covariance`.
    """
    variance = np.full(3, nan)
    if len(sigma_m):
        variance = np.maximum(np.median(sigma_m**2, axis=0) - np.diag(shared)[3:], 0.0)
    names = ("move_x", "move_y", "move_z")
    return ErrorSource("travel", names, np.diag(variance), "the trajectory's covariance")


def _yard_frame(summary: dict[str, Any]) -> YardFrame | None:
    file = summary["configuration"].get("yard")
    return read_yard_file(Path(str(file))) if file else None


def _frame_source(frame: YardFrame | None, shared: Float64, assumed: list[str]) -> list[ErrorSource]:
    if frame is None:
        assumed.append("no yard file was used: the mounting that the recording states counts as exact")
        return []
    names = ("turn_x", "turn_y", "turn_z", "move_x", "move_y", "move_z")
    return [ErrorSource("yard frame", names, shared, f"calibrate yard, {frame.path.name}")]


def _magnet_source(certificate: Path | None, assumed: list[str]) -> list[ErrorSource]:
    """Convert uncorrected touch-down errors to uncertainty, as their mean squares about 0."""
    touches = {} if certificate is None else touch_errors_m(certificate)
    sources = []
    for axis in "xyz":
        errors = list(touches.get(axis, {}).values())
        if errors:
            mean = np.array([[float(np.mean(np.square(errors)))]])
            by = f"{len(errors)} touch-downs of {Path(str(certificate)).name}"
            sources.append(
                ErrorSource("camera to magnet", (f"magnet_{axis}",), mean, by, "t", float(len(errors)))
            )
    if len(sources) < 3:
        assumed.append("no touch-downs along all axes: the crane's readings count as the magnet's place")
    return sources


def _offset_sources(offset: MagnetOffset, yaw_rad: float, assumed: list[str]) -> list[ErrorSource]:
    """Form the sources of a known offset from its sigma at a bundle's yaw, which already allows for the
    number of touch-downs.
    """
    if (turn_deg := offset.turn_deg(yaw_rad)) > MAX_TURN_DEG:
        assumed.append(
            f"the magnet's offset was found {turn_deg:.0f} deg from the bundle's yaw: no lift there"
        )
    return [
        ErrorSource("camera to magnet", (f"magnet_{axis}",), np.array([[sigma**2]]), "calibrate magnet")
        for axis, sigma in zip("xyz", offset.sigma_m(yaw_rad).tolist(), strict=True)
    ]
