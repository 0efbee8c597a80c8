"""Match a survey's bundles to known ones by place and dimensions, each at most once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Bool
from barsight.yard.inventory.changes import Finding, look_at
from barsight.yard.inventory.matching import (
    MIN_GAIN,
    Candidates,
    Places,
    agree_in_size,
    find_candidates,
    match_candidates,
)
from barsight.yard.types import Bundle, YardMap


@dataclass(frozen=True, eq=False)
class KnownBundle:
    """A bundle that other surveys saw.

    last: as last seen before this survey; later: as first seen after it. At least one is given. is_lifted:
    whether a lift has taken it since it was last seen; set_down: at the place where that lift laid it, None
    if that is unknown.
    """

    bundle_id: int
    last: Bundle | None
    later: Bundle | None
    stock_name: str | None
    is_lifted: bool = False
    set_down: Bundle | None = None

    @property
    def figures(self) -> Bundle:
        """Return the bundle as measured, regardless of its place."""
        found = self.last or self.later
        assert found is not None
        return found

    @property
    def places(self) -> tuple[Bundle, ...]:
        """Return the bundle at each place where it may be."""
        return tuple(place for place in (self.set_down, self.last, self.later) if place is not None)


@dataclass(frozen=True, eq=False)
class FoundBundle:
    """A bundle as a survey found it. stock_name: from its stock list, None if the list names none."""

    bundle: Bundle
    stock_name: str | None


@dataclass(frozen=True)
class MatchedBundles:
    """Result of matching, by positions in `known` and `found`.

    found: the found bundle for each matched known one. findings: for the known ones that were not found.
    """

    found: dict[int, int]
    findings: dict[int, Finding]


def match_by_place(
    known: tuple[KnownBundle, ...], found: tuple[FoundBundle, ...], heights: YardMap
) -> MatchedBundles:
    """Match bundles that lie in one place and agree in name or size. heights: the survey's map."""
    owned = [(i, place) for i, one in enumerate(known) for place in one.places]
    owner = np.array([i for i, _ in owned], np.int64)
    is_last = np.array([place is known[i].last for i, place in owned], np.bool_)
    is_left = is_last & np.array([known[i].is_lifted for i, _ in owned], np.bool_)
    near = find_candidates(Places.of([place for _, place in owned]), Places.of([one.bundle for one in found]))
    place, i, j = near.before, owner[near.before], near.after
    agree = _agree_in_name(_names(known)[i], _names(found)[j], near.agree)
    gain = np.where(is_left[place], MIN_GAIN, near.gain)  # unlikely where it was lifted from
    order = np.lexsort((-gain, j, i))
    order = order[agree[order]]
    _, first = np.unique(np.stack([i, j])[:, order], axis=1, return_index=True)
    best = order[first]  # of a bundle's places
    pairs = match_candidates(Candidates(i[best], j[best], near.in_place[best], agree[best], gain[best]))
    replaced = set(i[~agree & is_last[place]].tolist())
    findings = {
        i: _finding(one, heights, is_replaced=i in replaced) for i, one in enumerate(known) if i not in pairs
    }
    return MatchedBundles(pairs, findings)


def _names(bundles: Sequence[KnownBundle | FoundBundle]) -> NDArray[Any]:
    return np.array([one.stock_name for one in bundles], object)


def _agree_in_name(known: NDArray[Any], found: NDArray[Any], alike: Bool) -> Bool:
    """Compare the names of pairs (P,); `alike` where one has none."""
    return np.where(known.astype(np.bool_) & found.astype(np.bool_), known == found, alike)


def _finding(known: KnownBundle, heights: YardMap, *, is_replaced: bool) -> Finding:
    """Determine why a bundle was not found, from the survey's map at its last place.

    A lifted bundle is gone only if the place where the lift laid it is also empty.
    """
    if known.last is None:
        return "unseen"
    finding = look_at(known.last, heights)
    if finding == "not-found" and is_replaced:
        finding = "gone"
    if known.set_down is None or finding == "unseen":
        return finding
    set_down_finding = look_at(known.set_down, heights)
    return finding if set_down_finding == "gone" else set_down_finding


def match_carried(
    known: tuple[KnownBundle, ...], found: tuple[FoundBundle, ...], matched: MatchedBundles, new: list[int]
) -> dict[int, int]:
    """Pair gone bundles with new ones elsewhere, if each agrees with no other: by name, else by dimensions.

    new: positions in `found` at which a bundle may have been laid.
    """
    gone = np.array([i for i, finding in matched.findings.items() if finding == "gone"], np.int64)
    laid = np.array(new, np.int64)
    before = Places.of([known[i].figures for i in gone])
    after = Places.of([found[j].bundle for j in laid])
    names = _names(known)[gone], _names(found)[laid]
    agree = np.zeros((len(gone), len(laid)), np.bool_)
    for row in range(len(gone)):
        one = before.take(np.full(len(laid), row))
        all_seen = ~(one.ends_open.any(axis=1) | after.ends_open.any(axis=1))
        alike = agree_in_size(one, after) & all_seen
        agree[row] = _agree_in_name(names[0][[row]], names[1], alike)
    alone = agree & (agree.sum(axis=1) == 1)[:, None] & (agree.sum(axis=0) == 1)
    return {int(gone[row]): int(laid[column]) for row, column in np.argwhere(alone)}
