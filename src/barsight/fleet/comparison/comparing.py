"""Compare two versions of one recording: bundles and their sigma, vetoes, intervals, times."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

from barsight.core.errors import InputError
from barsight.core.json_values import json_digest
from barsight.core.reading.bounded_reading import in_range
from barsight.core.reading.sealed_json import SEAL
from barsight.fleet.ledger import REMEDY, result_note
from barsight.fleet.objects import Objects
from barsight.fleet.versions import FleetTask, places
from barsight.yard.inventory.bundle_file import bundle_of
from barsight.yard.inventory.matching import Places, match_bundles
from barsight.yard.types import Bundle

FIGURES = ("x_m", "y_m", "top_z_m", "yaw_deg", "length_m", "width_m")
"""Quantities of a bundle that are compared."""
_UNREAD = (KeyError, TypeError, ValueError, AttributeError, OverflowError)
"""Exceptions that a damaged document raises."""


@dataclass(frozen=True)
class FigureChange:
    """A quantity of a bundle under two versions.

    sigma: of the difference, as if the two were independent; since both saw the same pictures, it is an upper
    bound. p: two-sided probability of a difference this large.
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

    only_before, only_after: numbers of bundles without a partner. vetoes: codes that forbid all lifts and
    appeared (+) or vanished (-). lifts: how many lifts each other code forbids, before and after, and how
    many are `offered`. intervals: mean half width of the 95 % interval by quantity, before and after, None
    without an interval. seconds: measuring times, before and after. pictures: objects of the results with the
    pictures of the two reports.
    """

    recording: str
    changes: tuple[FigureChange, ...]
    only_before: tuple[int, ...]
    only_after: tuple[int, ...]
    vetoes: tuple[str, ...]
    lifts: dict[str, tuple[int, int]]
    intervals: dict[str, tuple[float | None, float | None]]
    seconds: tuple[float, float]
    pictures: tuple[str, str]


def compare_tasks(
    results: Objects,
    before: Sequence[FleetTask],
    after: Sequence[FleetTask],
    advance: Callable[[int, int], None],
) -> tuple[list[RecordingComparison], list[str]]:
    """Compare the recordings of two versions, identified by their content; list the others with a reason."""
    old, new = ({task.manifest or task.key: task for task in tasks} for tasks in (before, after))
    names = places((*before, *after))
    untold = [
        f"{names[task.key]} (of version {task.version.name} only)"
        for tasks, others in ((old, new), (new, old))
        for manifest, task in tasks.items()
        if manifest not in others
    ]
    both = [manifest for manifest in new if manifest in old]
    compared = []
    for number, manifest in enumerate(both):
        name = names[new[manifest].key]
        one = compare_recording(results, name, old[manifest].key, new[manifest].key)
        if one is None:
            untold.append(f"{name} (not measured under both)")
        else:
            compared.append(one)
        advance(number + 1, len(both))
    return compared, untold


def compare_recording(results: Objects, name: str, before: str, after: str) -> RecordingComparison | None:
    """Compare the results of two keys; None if one of them isn't published."""
    found = [result_note(results, key) for key in (before, after)]
    notes = [note for note in found if note is not None]
    if len(notes) < len(found):
        return None
    folders = [f"files/{note['key']}/{note['token']}" for note in notes]
    read = [_bundles(results, folder) for folder in folders]
    bundles = [{bundle.id: figures for bundle, figures in one} for one in read]
    old, new = (Places.of([bundle for bundle, _ in one]) for one in read)
    matched = match_bundles(old, new, sizes_agree=False)
    pairs = {read[0][i][0].id: read[1][j][0].id for i, j in matched.items()}
    changes = tuple(
        _change(name, i, figure, bundles[0][i], bundles[1][j]) for i, j in pairs.items() for figure in FIGURES
    )
    (whole, forbidden), (whole_after, forbidden_after) = (_vetoes(results, folder) for folder in folders)
    changed = [f"+{code}" for code in sorted(whole_after - whole)]
    changed += [f"-{code}" for code in sorted(whole - whole_after)]
    codes = (forbidden.keys() | forbidden_after.keys()) - whole - whole_after
    return RecordingComparison(
        name, changes, tuple(sorted(bundles[0].keys() - pairs.keys())),
        tuple(sorted(bundles[1].keys() - set(pairs.values()))), tuple(changed),
        {code: (forbidden[code], forbidden_after[code]) for code in sorted(codes)},
        {figure: _half_widths(figure, *bundles) for figure in FIGURES} if all(bundles) else {},
        (notes[0]["measured_s"], notes[1]["measured_s"]),
        (f"{folders[0]}/preview.png", f"{folders[1]}/preview.png"),
    )  # fmt: skip


def _bundles(results: Objects, folder: str) -> list[tuple[Bundle, dict[str, float]]]:
    """Read a result's bundles, each with its quantities, and the sigma of each as `figure sigma`."""
    content = _document(results, f"{folder}/bundles.json")
    try:
        return [(bundle_of(one), _figures(one)) for one in content["bundles"]]
    except _UNREAD as error:
        raise _torn(results, f"{folder}/bundles.json", error) from error


def _figures(one: dict[str, Any]) -> dict[str, float]:
    sigma, (ahead_x, ahead_y, _) = one["sigma"], one["direction"]
    # An open end leaves the position along the bars unknown, and everything that depends on it.
    along, across = (math.inf if sigma[name] is None else sigma[name] for name in ("along_m", "lateral_m"))
    x_m, y_m, _ = one["axis_centre_m"]
    figures = {"x_m": x_m, "y_m": y_m, **{name: one[name] for name in FIGURES[2:]}}
    sigmas = {
        "x_m": math.hypot(_projected(along, ahead_x), _projected(across, ahead_y)),
        "y_m": math.hypot(_projected(along, ahead_y), _projected(across, ahead_x)),
        **{name: sigma[name] for name in FIGURES[2:]},
    }
    figures |= {f"{name} sigma": one for name, one in sigmas.items() if one is not None and one < math.inf}
    if not in_range(list(figures.values())).all():
        raise ValueError("a figure is out of range")
    return {f"{name} sigma": math.inf for name in FIGURES} | figures


def _projected(sigma: float, cosine: float) -> float:
    return sigma * abs(cosine) if cosine else 0.0


def _document(results: Objects, path: str) -> dict[str, Any]:
    """Read a sealed document of a result, of any version. Raises InputError."""
    content = results.read_json(path)
    if not isinstance(content, dict):
        problem = "is gone" if content is None else "is no object"
        raise InputError(f"{results.url}/{path}", problem, REMEDY)
    if content.get(SEAL) != json_digest({key: value for key, value in content.items() if key != SEAL}):
        raise InputError(f"{results.url}/{path}", "was changed after it was written", REMEDY)
    return content


def _torn(results: Objects, path: str, error: Exception) -> InputError:
    return InputError(f"{results.url}/{path}", f"is damaged ({type(error).__name__}: {error})", REMEDY)


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


def _vetoes(results: Objects, folder: str) -> tuple[set[str], Counter[str]]:
    """Read the codes that forbid all lifts, and the number of lifts that each other code forbids; offered
    lifts are counted as `offered`.
    """
    path = f"{folder}/lifts.json"
    content = _document(results, path)
    try:
        whole = {str(one["code"]) for one in content["vetoes"]}
        counted = Counter(
            code
            for lift in content["refused"]
            for code in {str(one["code"]) for one in lift["vetoes"]} - whole
        )
        counted["offered"] = len(content["lifts"])
    except _UNREAD as error:
        raise _torn(results, path, error) from error
    return whole, counted


def _half_widths(
    figure: str, before: dict[int, dict[str, float]], after: dict[int, dict[str, float]]
) -> tuple[float | None, float | None]:
    def mean(found: dict[int, dict[str, float]]) -> float | None:
        known = [s for one in found.values() if math.isfinite(s := one[f"{figure} sigma"])]
        return 1.96 * sum(known) / len(known) if known else None

    return mean(before), mean(after)
