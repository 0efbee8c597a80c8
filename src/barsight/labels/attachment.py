"""Merge what several pictures read of one label, attach it to a bundle and compare it with the stock list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.inventory.stock_list import ListedBundle
from barsight.yard.types import Bundle

MIN_PICTURES, MIN_NUMBER_PICTURES = 2, 3
"""Minimum number of pictures that must read the same code, or the same plain number, which has no check
digit, for it to be trusted.
"""
NUMBER = "number"
"""Value of `kind` for a plain number."""
SAME_PLACE_M = 0.15
BESIDE_M, BELOW_TOP_M = 0.03, 0.15
"""Maximum distance of a label's middle outside a bundle's outline, and above or below its top."""
LISTED_REACH_M = 0.5
"""Maximum distance of a bundle's listed position beyond half its length and half its width."""


@dataclass(frozen=True, eq=False)
class PlacedCode:
    """A code that one picture read, at its position (3,) on the map. picture: its stamp and camera."""

    text: str
    kind: str
    place_m: Float64
    picture: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Label:
    """A label. place_m: (3,) median position over its pictures. pictures: number that read this text;
    agreement_ratio: their share of all that read anything there. is_sure: read by enough pictures,
    contradicted by none, and clear of other bundles' borders. bundle: id of its bundle, None if it is on no
    known one. doubts: sentences.
    """

    text: str
    kind: str
    place_m: Float64
    pictures: int
    agreement_ratio: float
    is_sure: bool
    bundle: int | None
    doubts: tuple[str, ...]


def merge_codes(codes: Sequence[PlacedCode], bundles: Sequence[Bundle]) -> tuple[Label, ...]:
    """Merge readings of one text at one position, sorted by their positions along X."""
    groups: list[list[PlacedCode]] = []
    for code in codes:
        for group in groups:
            near = np.linalg.norm(_middle(group) - code.place_m) < SAME_PLACE_M
            if group[0].text == code.text and group[0].kind == code.kind and near:
                group.append(code)
                break
        else:
            groups.append([code])
    groups.sort(key=lambda group: tuple(_middle(group)))
    return tuple(_label(group, groups, bundles) for group in groups)


def _middle(group: Sequence[PlacedCode]) -> Float64:
    middle: Float64 = np.median([code.place_m for code in group], axis=0)
    return middle


def _label(
    group: Sequence[PlacedCode], groups: Sequence[Sequence[PlacedCode]], bundles: Sequence[Bundle]
) -> Label:
    place, pictures = _middle(group), len({code.picture for code in group})
    there = [
        other
        for other in groups
        if other is not group and np.linalg.norm(_middle(other) - place) < SAME_PLACE_M
    ]
    others = sum(len({code.picture for code in other}) for other in there)
    doubts = [f"{len(there)} other text(s) read at the same place"] if there else []
    needed = MIN_NUMBER_PICTURES if group[0].kind == NUMBER else MIN_PICTURES
    if pictures < needed:
        doubts.append(f"read in {pictures} picture{'s' * (pictures > 1)}, {needed} are needed")
    bundle, beside = _bundle_at(place, bundles)
    if beside:
        doubts.append(f"it lies on the border of {', '.join(f'bundle {one.id}' for one in beside)}")
    return Label(
        group[0].text, group[0].kind, place, pictures, pictures / (pictures + others), not doubts,
        None if bundle is None else bundle.id, tuple(doubts),
    )  # fmt: skip


def _bundle_at(place_m: Float64, bundles: Sequence[Bundle]) -> tuple[Bundle | None, list[Bundle]]:
    """Find the bundle whose top carries a position, within BESIDE_M and BELOW_TOP_M; the highest of several
    if it lies well inside, otherwise the one inside which it lies furthest, with the others that may carry
    it.
    """
    found = []
    for bundle in bundles:
        across, along = _across_along(bundle, place_m)
        inside_m = min(bundle.width_m / 2 - across, bundle.length_m / 2 - along)
        if inside_m >= -BESIDE_M and abs(place_m[2] - bundle.top_z_m) <= BELOW_TOP_M:
            found.append((bundle, inside_m))
    if not found:
        return None, []
    best, inside_m = max(found, key=lambda one: one[0].top_z_m)
    if inside_m >= BESIDE_M:
        return best, []
    best, _ = max(found, key=lambda one: one[1])
    return best, [bundle for bundle, _ in found if bundle is not best]


def _across_along(bundle: Bundle, place_m: Float64) -> tuple[float, float]:
    """Compute the distances of a position from a bundle's axis and, along it, from its middle, in plan
    view.
    """
    away = place_m[:2] - bundle.centre_m[:2]
    axis = np.array([-np.sin(bundle.yaw_rad), np.cos(bundle.yaw_rad)])
    return abs(float(away @ [axis[1], -axis[0]])), abs(float(away @ axis))


def contradictions(
    labels: Sequence[Label], bundles: Sequence[Bundle], listed: Sequence[ListedBundle]
) -> tuple[str, ...]:
    """List the contradictions between trusted labels and the stock list, which match by the list's names."""
    by_name, by_id = {one.name: one for one in listed}, {bundle.id: bundle for bundle in bundles}
    found, seen = [], dict[str, Label]()
    for label in labels:
        if not label.is_sure:
            continue
        one = by_name.get(label.text)
        if one is None:
            found.append(f"label {label.text!r} is not in the list")
            continue
        if label.text in seen and (label.bundle is None or label.bundle != seen[label.text].bundle):
            found.append(f"label {label.text!r} lies at two places")
        seen[label.text] = label
        if label.bundle is not None and not _listed_there(one, by_id[label.bundle]):
            x, y = by_id[label.bundle].centre_m[:2]
            found.append(
                f"{one.name} is listed at x {one.x_m:.2f} m, y {one.y_m:.2f} m; its label lies on bundle "
                f"{label.bundle} at x {x:.2f} m, y {y:.2f} m"
            )
    return tuple(found)


def _listed_there(one: ListedBundle, bundle: Bundle) -> bool:
    across, along = _across_along(bundle, np.array([one.x_m, one.y_m]))
    half = bundle.width_m / 2, bundle.length_m / 2
    return across <= half[0] + LISTED_REACH_M and along <= half[1] + LISTED_REACH_M
