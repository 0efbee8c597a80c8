"""Select among conflicting readings the set that explains the most of the map."""

from __future__ import annotations

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csc_matrix, csr_matrix

from barsight.core.arrays import Float64, Int64

NARROWER, _INSIDE_RATIO, _NEARLY = 0.65, 0.5, 0.8
"""Limits for readings that lie side by side in a wider one: maximum width relative to it, minimum share of
their place that is its too, minimum sum of their weights relative to its own.
"""


def choose_readings(weights: Float64, claims: list[Int64]) -> Int64:
    """Choose the readings (indices) with the largest total weight so that no place is claimed twice.

    weights: (N,) what each reading explains. claims: for each reading, the numbers of the places it takes.
    Raises RuntimeError where the solver finds no choice.
    """
    useful = [k for k in range(len(claims)) if weights[k] > 0 and claims[k].size > 0]
    if not useful:
        return np.empty(0, np.int64)
    owner, place = _owners([claims[k] for k in useful])
    table = _rivals(owner, place, len(useful))
    if table.shape[0] == 0:
        return np.array(useful, np.int64)
    solved = milp(
        -weights[useful], integrality=np.ones(len(useful), np.int64), bounds=Bounds(0, 1),
        constraints=LinearConstraint(table, -np.inf, 1),
    )  # fmt: skip
    if solved.x is None:
        raise RuntimeError(f"no choice of readings: {solved.message}")
    return np.array(useful, np.int64)[np.flatnonzero(solved.x > 0.5)]


def best_intervals(low: Float64, high: Float64, weight: Float64) -> list[int]:
    """Solve weighted interval scheduling: find the disjoint intervals with the largest total weight."""
    order = np.argsort(high, kind="stable")
    before = np.searchsorted(high[order], low[order], side="right")
    total = np.zeros(order.size + 1)
    for n, k in enumerate(order):
        total[n + 1] = max(total[n], total[min(before[n], n)] + weight[k])
    kept, n = [], order.size
    while n > 0:
        k = order[n - 1]
        if total[n] > total[n - 1]:
            kept.append(int(k))
            n = int(min(before[n - 1], n - 1))
        else:
            n -= 1
    return kept


def without_slivers(claims: list[Int64], min_ratio: float) -> list[Int64]:
    """Remove the places that two claims share where these are less than min_ratio of the smaller claim: then
    only their edges meet. The larger claim gives them up.
    """
    if not claims:
        return []
    owner, place = _owners(claims)
    takes = csr_matrix((np.ones(owner.size), (owner, place)), shape=(len(claims), int(place.max()) + 1))
    common = (takes @ takes.T).tocoo()
    sizes = np.array([claim.size for claim in claims])
    out = list(claims)
    for i, j, cells in zip(common.row.tolist(), common.col.tolist(), common.data.tolist(), strict=True):
        if cells < min_ratio * min(sizes[i], sizes[j]) and (sizes[i], i) > (sizes[j], j):
            out[i] = np.setdiff1d(out[i], claims[j], assume_unique=True)
    return out


def _rivals(owner: Int64, place: Int64, readings: int) -> csc_matrix:
    """Build a row for each set of two or more readings that claim the same places, with 1 for its members.

    Sets are distinguished by the sum of random numbers, one drawn for each reading: with 62 bits each,
    collisions don't occur in practice.
    """
    takes = csr_matrix((np.ones(owner.size), (place, owner)), shape=(int(place.max()) + 1, readings))
    mark = np.random.default_rng(0).integers(1 << 62, size=readings)
    marks = np.zeros(takes.shape[0], np.int64)
    np.add.at(marks, place, mark[owner])
    first = np.unique(marks, return_index=True)[1]
    return csc_matrix(takes[first[np.diff(takes.indptr)[first] > 1]])


def overlaps(chosen: Int64, claims: list[Int64]) -> Float64:
    """Compute the fraction (chosen, N) of each chosen reading's place that every reading claims."""
    if chosen.size == 0:
        return np.empty((0, len(claims)))
    owner, place = _owners(claims)
    takes = csc_matrix((np.ones(owner.size), (owner, place)), shape=(len(claims), int(place.max()) + 1))
    sizes = np.array([claims[k].size for k in chosen])
    shares: Float64 = (takes[chosen] @ takes.T).toarray() / sizes[:, None]
    return shares


def strongest_rivals(chosen: Int64, weights: Float64, wanted: Float64) -> list[int | None]:
    """Find for each chosen reading the heaviest of the others that claim more than half of its place."""
    if chosen.size == 0:
        return []
    wants = wanted > 0.5
    wants[np.arange(chosen.size), chosen] = False
    rated = np.where(wants & (weights > 0), weights, 0.0)
    best = rated.argmax(axis=1)
    return [int(k) if rated[row, k] > 0 else None for row, k in enumerate(best)]


def holds_several(k: int, widths_m: Float64, weights: Float64, claims: list[Int64]) -> bool:
    """Check whether several narrower readings side by side explain the place of reading k nearly as well."""
    inside = [
        j
        for j in np.flatnonzero((widths_m < NARROWER * widths_m[k]) & (weights > 0)).tolist()
        if np.isin(claims[j], claims[k], assume_unique=True).sum() > _INSIDE_RATIO * claims[j].size
    ]
    best = choose_readings(weights[inside], [claims[j] for j in inside])
    return best.size > 1 and bool(weights[inside][best].sum() > _NEARLY * weights[k])


def _owners(claims: list[Int64]) -> tuple[Int64, Int64]:
    """List every claim as a pair: index of the reading and index of the place, both counted from 0."""
    owner = np.repeat(np.arange(len(claims), dtype=np.int64), [claim.size for claim in claims])
    _, place = np.unique(np.concatenate(claims), return_inverse=True)
    return owner, place.astype(np.int64)
