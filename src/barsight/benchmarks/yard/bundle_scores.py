"""Score detected bundles against the true ones of a simulated yard."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.benchmarks.provenance import Provenance, provenance
from barsight.core.arrays import Float64
from barsight.core.errors import InputError
from barsight.core.linalg.robust import SIGMAS_95
from barsight.simulation.worlds.solids import STEEL_KG_PER_M3
from barsight.yard.axes import axes_of, turn_between
from barsight.yard.types import Bundle
from barsight.yard.weight import bundle_mass

_COUNTS = ("free", "found", "claimed", "wrong", "said_count", "right_count")


@dataclass(frozen=True, eq=False)
class TrueBundle:
    """centre_m: (3,) midpoint of the axis. on_top: no bundle lies on it. mass_kg: total mass of its bars."""

    centre_m: Float64
    yaw_rad: float
    length_m: float
    width_m: float
    top_z_m: float
    bar_diameter_m: float
    bars: int
    on_top: bool
    mass_kg: float


@dataclass(frozen=True, eq=False)
class BundleErrors:
    """Errors of the detected free bundles, pooled over yards, with counts of missed and false ones.

    errors, sigmas: (N,) by figure, detected minus true, m, rad, t; NaN where the figure is unknown. free:
    true bundles with nothing on them; found: those of them that were detected; claimed: detected bundles
    reported as free; wrong: those of them without a free true bundle. said_count, right_count: pairs whose
    number of bars was reported, and those in which it was right.
    """

    errors: dict[str, Float64]
    sigmas: dict[str, Float64]
    free: int
    found: int
    claimed: int
    wrong: int
    said_count: int
    right_count: int
    confidence: Float64
    is_right: Float64


def read_true_bundles(recording: Path) -> tuple[TrueBundle, ...]:
    """Read truth/bundles.json of a simulated recording."""
    path = recording / "truth" / "bundles.json"
    if not path.is_file():
        raise InputError(path, "no such file", "give a simulated recording")
    return tuple(
        TrueBundle(
            np.array(row["center"]), float(np.radians(row["yaw_deg"])), row["length"],
            _width(row), row["top_z"], row["bar_diameter"], row["bars"], row["on_top"],
            row.get("mass_kg", bars_mass(row["bars"], row["bar_diameter"], row["length"])),
        )
        for row in json.loads(path.read_text(encoding="utf-8"))
    )  # fmt: skip


def _width(row: dict[str, Any]) -> float:
    """Compute a true bundle's width, m, from its outline (x, z), its stored width or its enclosing circle."""
    if "outline" in row:
        return float(np.ptp(np.array(row["outline"])[:, 0]))
    return float(row.get("width", 2 * row["bundle_radius"]))


def bars_mass(bars: int, diameter_m: float, length_m: float) -> float:
    """Compute the mass of round steel bars of equal length, kg."""
    return STEEL_KG_PER_M3 * np.pi / 4 * diameter_m**2 * length_m * bars


def score_bundles(found: tuple[Bundle, ...], true: tuple[TrueBundle, ...]) -> BundleErrors:
    """Pair each free true bundle with the nearest detected one whose axis runs inside it."""
    free = [t for t in true if t.on_top]
    claimed = [b for b in found if b.on_top]
    pairs, used = [], set()
    for t in free:
        near = [(abs(_offset(b, t)[0]), k) for k, b in enumerate(claimed) if k not in used and _inside(b, t)]
        if near:
            used.add(min(near)[1])
            pairs.append((claimed[min(near)[1]], t))
    errors: dict[str, list[float]] = {}
    sigmas: dict[str, list[float]] = {}
    for b, t in pairs:
        for name, (error, sigma) in _errors(b, t).items():
            errors.setdefault(name, []).append(error)
            sigmas.setdefault(name, []).append(sigma)
    counted = [(b.bars, t.bars) for b, t in pairs if b.bars is not None]
    return BundleErrors(
        errors={name: np.array(values) for name, values in errors.items()},
        sigmas={name: np.array(values) for name, values in sigmas.items()},
        free=len(free),
        found=len(pairs),
        claimed=len(claimed),
        wrong=len(claimed) - len(used),
        said_count=len(counted),
        right_count=sum(said == is_ for said, is_ in counted),
        confidence=np.array([b.confidence for b in claimed]),
        is_right=np.array([float(k in used) for k in range(len(claimed))]),
    )


def join_scores(parts: list[BundleErrors]) -> BundleErrors:
    """Join the scores of several yards."""
    names = sorted({name for part in parts for name in part.errors})
    none = np.empty(0)

    def stack(tables: list[dict[str, Float64]]) -> dict[str, Float64]:
        return {name: np.concatenate([table.get(name, none) for table in tables]) for name in names}

    return BundleErrors(
        errors=stack([p.errors for p in parts]),
        sigmas=stack([p.sigmas for p in parts]),
        **{name: sum(getattr(part, name) for part in parts) for name in _COUNTS},
        confidence=np.concatenate([p.confidence for p in parts]),
        is_right=np.concatenate([p.is_right for p in parts]),
    )


def score_figures(scores: BundleErrors) -> dict[str, dict[str, float]]:
    """Summarise each figure: count, bias, median and P95 of the absolute error (mm, degrees, kg), and the
    share of errors within the 95 % interval.
    """
    out = {}
    for name, error in scores.errors.items():
        sigma = scores.sigmas[name]
        known = np.isfinite(error)
        if not known.any():
            continue
        unit = np.degrees(1.0) if name == "yaw" else 1e3
        size = np.abs(error[known])
        out[name] = {
            "samples": float(known.sum()),
            "bias": float(error[known].mean() * unit),
            "median": float(np.median(size) * unit),
            "p95": float(np.percentile(size, 95) * unit),
            "max": float(size.max() * unit),
            "within_95_pct": float(100 * np.mean(size <= SIGMAS_95 * sigma[known])),
        }
    return out


@dataclass(frozen=True)
class BundleReport:
    """A bundle benchmark's record, for a file. cpu_seconds: per yard; empty for a measured folder."""

    provenance: Provenance
    counts: dict[str, int]
    figures: dict[str, dict[str, float]]
    cpu_seconds: tuple[float, ...]


def bundle_report(scores: BundleErrors, cpu_seconds: tuple[float, ...]) -> BundleReport:
    """Build the counts and figures, with commit and machine."""
    counts = {name: int(getattr(scores, name)) for name in _COUNTS}
    return BundleReport(provenance(), counts, score_figures(scores), cpu_seconds)


def bundle_table(scores: BundleErrors) -> Table:
    """Tabulate the figures for the terminal; lengths in mm, yaw in degrees, mass in kg."""
    title = (
        f"{scores.found} of {scores.free} free bundles found, {scores.wrong} of {scores.claimed} false; "
        f"bars counted right in {scores.right_count} of {scores.said_count}"
    )
    table = Table("figure", title=title, box=SIMPLE_HEAD)
    for head in ("n", "bias", "median", "P95", "max", "in 95 %"):
        table.add_column(head, justify="right")
    for name, row in score_figures(scores).items():
        digits = 3 if name == "yaw" else 1
        numbers = (f"{row[key]:.{digits}f}" for key in ("bias", "median", "p95", "max"))
        table.add_row(name, f"{row['samples']:.0f}", *numbers, f"{row['within_95_pct']:.1f}")
    return table


def reliability(scores: BundleErrors) -> str:
    """Compare the stated confidence of the bundles reported as free with the share of them that is right."""
    out = []
    for name, part in (("0.9 or more", scores.confidence >= 0.9), ("less", scores.confidence < 0.9)):
        if part.any():
            stated, right = scores.confidence[part].mean(), scores.is_right[part].mean()
            out.append(f"{name}: {part.sum()} bundles, stated {stated:.2f}, right {right:.2f}")
    return f"confidence {'; '.join(out) or '-'}"


def _offset(found: Bundle, true: TrueBundle) -> tuple[float, float]:
    """Compute the detected centre's offset from the true one, across and along the true axis, m."""
    across, along = (axes_of(true.yaw_rad) @ (found.centre_m - true.centre_m)[:2]).tolist()
    return across, along


def _inside(found: Bundle, true: TrueBundle) -> bool:
    across, along = _offset(found, true)
    turned = abs(turn_between(true.yaw_rad, found.yaw_rad))
    level = abs(found.top_z_m - true.top_z_m) < true.width_m / 2
    return abs(across) < true.width_m / 2 and abs(along) < true.length_m / 2 and turned < 0.2 and level


def _errors(found: Bundle, true: TrueBundle) -> dict[str, tuple[float, float]]:
    sigma, mass = found.sigma, bundle_mass(found)
    along = axes_of(true.yaw_rad)[1]
    flip = 1 if np.cos(found.yaw_rad - true.yaw_rad) > 0 else -1
    out = {
        "lateral": (_offset(found, true)[0], sigma.lateral_m),
        "yaw": (turn_between(true.yaw_rad, found.yaw_rad), sigma.yaw_rad),
        "top": (found.top_z_m - true.top_z_m, sigma.top_z_m),
        "width": (found.width_m - true.width_m, sigma.width_m),
        "diameter": (found.bar_diameter_m - true.bar_diameter_m, sigma.bar_diameter_m),
        "mass": ((mass.kg - true.mass_kg) / 1e3, mass.sigma_kg / 1e3),
    }
    for k, name in enumerate(("low end", "high end")):
        side = (-1, 1)[k] * flip
        error = float((found.ends_m[k] - true.centre_m)[:2] @ along) - side * true.length_m / 2
        out[name] = (
            (float("nan"), float("nan")) if found.ends_open[k] else (side * error, found.ends_sigma_m[k])
        )
    return out
