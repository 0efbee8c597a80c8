"""Compare two versions of one recording: bundles and their sigma, vetoes, intervals, times."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

from barsight.fleet.objects import Objects

FIGURES = ("x_m", "y_m", "top_z_m", "yaw_deg", "length_m", "width_m")
"""Figures of a bundle that are compared."""
MAX_APART_M = 0.5
"""Distance up to which two bundles are taken for one."""


@dataclass(frozen=True)
class FigureChange:
    """A figure of a bundle under two versions. sigma: of the difference, as if the two were independent;
    both saw the same pictures, so it is an upper bound. p: two-sided chance of a difference this large.
    """

    recording: str
    bundle: int
    figure: str
    before: float
    after: float
    sigma: float
    p: float


@dataclass(frozen=True)
class RecordingComparison:
    """A recording under two versions.

    only_before, only_after: numbers of bundles without a partner. vetoes: codes that appeared (+) and
    vanished (-). intervals: mean half width of the 95 % interval by figure, before and after. seconds:
    measured, before and after. pictures: URLs of the two reports' pictures.
    """

    recording: str
    changes: tuple[FigureChange, ...]
    only_before: tuple[int, ...]
    only_after: tuple[int, ...]
    vetoes: tuple[str, ...]
    intervals: dict[str, tuple[float, float]]
    seconds: tuple[float, float]
    pictures: tuple[str, str]


def compare_recording(results: Objects, name: str, before: str, after: str) -> RecordingComparison | None:
    """Compare the results of two keys; None where one of them isn't published."""
    notes = [results.read_json(f"results/{key}/result.json") for key in (before, after)]
    if None in notes:
        return None
    folders = [f"files/{note['key']}/{note['token']}" for note in notes]
    bundles = [_bundles(results, folder) for folder in folders]
    pairs = _partners(*bundles)
    changes = tuple(
        _change(name, i, figure, bundles[0][i], bundles[1][j]) for i, j in pairs.items() for figure in FIGURES
    )
    vetoes = [_vetoes(results, folder) for folder in folders]
    return RecordingComparison(
        name, changes, tuple(sorted(bundles[0].keys() - pairs.keys())),
        tuple(sorted(bundles[1].keys() - set(pairs.values()))),
        tuple(
            sign + code
            for sign, codes in (("+", vetoes[1] - vetoes[0]), ("-", vetoes[0] - vetoes[1]))
            for code in sorted(codes)
        ),
        {figure: _half_widths(figure, *bundles) for figure in FIGURES} if all(bundles) else {},
        (notes[0]["measured_s"], notes[1]["measured_s"]),
        (f"{results.url}/{folders[0]}/preview.png", f"{results.url}/{folders[1]}/preview.png"),
    )  # fmt: skip


def _bundles(results: Objects, folder: str) -> dict[int, dict[str, float]]:
    """Read a result's bundles: each figure, and its sigma as `figure sigma`."""
    content = results.read_json(f"{folder}/bundles.json") or {"bundles": []}
    found = {}
    for one in content["bundles"]:
        sigma, (ahead_x, ahead_y, _) = one["sigma"], one["direction"]
        along, across = sigma["along_m"] ** 2, sigma["lateral_m"] ** 2
        x_m, y_m, _ = one["axis_centre_m"]
        x_variance = along * ahead_x**2 + across * ahead_y**2
        y_variance = along * ahead_y**2 + across * ahead_x**2
        figures = {"x_m": x_m, "y_m": y_m, **{name: one[name] for name in FIGURES[2:]}}
        figures |= {"x_m sigma": math.sqrt(x_variance), "y_m sigma": math.sqrt(y_variance)}
        found[one["id"]] = figures | {f"{name} sigma": _or_unknown(sigma[name]) for name in FIGURES[2:]}
    return found


def _or_unknown(sigma: float | None) -> float:
    return math.inf if sigma is None else sigma


def _partners(before: dict[int, dict[str, float]], after: dict[int, dict[str, float]]) -> dict[int, int]:
    """Pair the bundles of two results, the nearest first, by centre and top."""
    apart = sorted(
        (math.dist(*([one[name] for name in FIGURES[:3]] for one in (a, b))), i, j)
        for i, a in before.items()
        for j, b in after.items()
    )
    pairs: dict[int, int] = {}
    for distance, i, j in apart:
        if distance <= MAX_APART_M and i not in pairs and j not in pairs.values():
            pairs[i] = j
    return pairs


def _change(
    name: str, number: int, figure: str, before: dict[str, float], after: dict[str, float]
) -> FigureChange:
    difference = after[figure] - before[figure]
    if figure == "yaw_deg":
        difference = (difference + 90) % 180 - 90
    sigma = math.hypot(before[f"{figure} sigma"], after[f"{figure} sigma"])
    z = abs(difference) / sigma if sigma > 0 else (math.inf if difference else 0.0)
    return FigureChange(
        name, number, figure, before[figure], before[figure] + difference, sigma, 2 * NormalDist().cdf(-z)
    )


def _vetoes(results: Objects, folder: str) -> set[str]:
    """Read the codes that forbid: of the whole map, and of each refused lift with how often."""
    data = results.read(f"{folder}/lifts.json")
    if data is None:
        return set()
    content = json.loads(data)
    codes = [_code(one) for one in content.get("vetoes", [])]
    refused: list[Any] = content.get("refused", [])
    counted: dict[str, int] = {}
    for one in refused:
        code = _code(one)
        counted[code] = counted.get(code, 0) + 1
    return {*codes, *(f"{code} x{count}" for code, count in counted.items())}


def _code(one: Any) -> str:
    return str(one.get("code", one.get("reason", "refused"))) if isinstance(one, dict) else str(one)


def _half_widths(
    figure: str, before: dict[int, dict[str, float]], after: dict[int, dict[str, float]]
) -> tuple[float, float]:
    def mean(found: dict[int, dict[str, float]]) -> float:
        known = [s for one in found.values() if math.isfinite(s := one[f"{figure} sigma"])]
        return 1.96 * sum(known) / max(1, len(known))

    return mean(before), mean(after)
