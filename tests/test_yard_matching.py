"""The matching of bundles against the truth of drawn pairs of yards."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np

from barsight.yard.inventory.changes import MAX_MOVE_M
from barsight.yard.inventory.matching import Places, common_shift, displace, match_bundles
from barsight.yard.types import Bundle
from lift_yards import SIGMA, laid, record
from yard_maps import Laid

KINDS = [(7, 0.09), (7, 0.06), (19, 0.05), (19, 0.055)]


def draw_row(rng: np.random.Generator) -> list[Laid]:
    """Bundles side by side, most as their neighbours, with gaps of 10 to 150 mm."""
    row, x_m = [], 0.0
    bars, diameter_m = KINDS[rng.integers(4)]
    for _ in range(30):
        if rng.random() < 0.25:
            bars, diameter_m = KINDS[rng.integers(4)]
        one = laid(x_m, bars=bars, diameter_m=diameter_m, yaw_deg=float(rng.normal(0, 0.4)))
        step_m = one.width_m + float(rng.choice([0.01, 0.05, 0.15]))
        row.append(replace(one, x_m=x_m + step_m / 2))
        x_m += step_m
    return row


def work(rng: np.random.Generator, row: list[Laid]) -> list[tuple[int, float, Laid]]:
    """Take some, nudge some by 5 to 500 mm, lay new ones at the end: each one's index before, and its way."""
    lying = []
    for k, one in enumerate(row):
        chance, way_m = rng.random(), 0.0
        if chance < 0.1:
            way_m = math.exp(rng.uniform(math.log(0.005), math.log(0.5)))
        if chance < 0.85:
            lying.append((k, way_m, replace(one, x_m=one.x_m + float(rng.choice([-1, 1])) * way_m)))
    end = row[-1]
    lying += [(-1 - k, 0.0, replace(end, x_m=end.x_m + (k + 1) * (end.width_m + 0.05))) for k in range(4)]
    return [lying[k] for k in rng.permutation(len(lying))]


def measured(rng: np.random.Generator, one: Laid, number: int, shift_m: np.ndarray) -> Bundle:
    draw = rng.normal
    seen = replace(
        one, x_m=one.x_m + draw(0, SIGMA.lateral_m) + shift_m[0], y_m=draw(0, SIGMA.along_m) + shift_m[1],
        yaw_deg=one.yaw_deg + math.degrees(draw(0, SIGMA.yaw_rad)),
        length_m=one.length_m + draw(0, SIGMA.length_m),
    )  # fmt: skip
    return record(
        seen, number, top_z_m=one.top_z_m + draw(0, SIGMA.top_z_m) + shift_m[2],
        width_m=one.width_m + draw(0, SIGMA.width_m),
        bar_diameter_m=one.diameter_m + draw(0, SIGMA.bar_diameter_m),
    )  # fmt: skip


def judged(seeds: range, reach_m: float, frame_sigma_m: float) -> Counter[str]:
    """Match yards before and after a crane's work, and count against truth."""
    told: Counter[str] = Counter()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        row = draw_row(rng)
        lying = work(rng, row)
        before = Places.of([measured(rng, one, k, np.zeros(3)) for k, one in enumerate(row)])
        shift_m = rng.normal(0, (frame_sigma_m, frame_sigma_m, frame_sigma_m / 4))
        after = Places.of([measured(rng, one, k, shift_m) for k, (_, _, one) in enumerate(lying)])
        pairs = match_bundles(before, after, reach_m)
        old, new = before.take(list(pairs)), after.take(list(pairs.values()))
        moved = dict(zip(pairs, displace(old, new, common_shift(old, new)).moved().tolist(), strict=True))
        told["wrong"] += sum(lying[j][0] != i for i, j in pairs.items())
        for i, way_m, _ in lying:
            if i >= 0:
                kind = "kept" if way_m == 0 else "far" if way_m > 0.05 else "near"
                told.update([kind, f"{kind} lost"] if i not in pairs else [kind])
                told[f"{kind} moved"] += moved.get(i, False)
    return told


def test_what_lies_is_matched_to_itself_and_hardly_ever_called_moved() -> None:
    for frame_sigma_m in (0.0, 0.02):
        told = judged(range(20), MAX_MOVE_M, frame_sigma_m)
        assert told["kept"] > 400 and told["kept lost"] == 0
        assert told["wrong"] <= 0.025 * told["kept"]  # of those gone, by an alike neighbour that moved
        assert told["kept moved"] <= 0.005 * told["kept"]
        assert told["far lost"] <= 0.15 * told["far"]
        assert told["far moved"] >= 0.8 * told["far"]


def test_in_one_place_no_neighbour_is_taken_for_another() -> None:
    told = judged(range(20), 0.0, 0.006)
    assert told["kept lost"] == 0 and told["wrong"] <= 0.005 * told["kept"]
