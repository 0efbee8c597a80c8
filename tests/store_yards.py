"""A yard that a crane works in, surveyed again and again: truth and measured folders, drawn from geometry."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from barsight.core.stamps import NS_PER_S
from barsight.result_folder import seal_map
from barsight.yard.inventory.bundle_file import write_bundles
from barsight.yard.types import Bundle, HeightMap
from lift_yards import SIGMA, record, sure_travel
from result_folders import summary
from yard_folders import write_heights
from yard_maps import Laid

CELL_M = 0.04
PITCH_M = 0.7
SLOTS = 16
START_NS = 1_700_000_000 * NS_PER_S
KINDS = [(7, 0.09), (7, 0.06), (19, 0.05), (19, 0.075)]
LENGTHS_M = [4.5, 5.0, 6.0]
MISSED = 0.02
"""Share of visible bundles that a survey does not tell."""


@dataclass(frozen=True)
class View:
    """A survey's view: m along x, and up to where along y."""

    from_x_m: float
    to_x_m: float
    to_y_m: float = 9.9

    def sees(self, slot: int) -> bool:
        return self.from_x_m < PITCH_M * slot - 0.35 and PITCH_M * slot + 0.35 < self.to_x_m


WHOLE = View(-9.0, 99.0)


class CraneYard:
    """Places of two layers: `lying` has, by (slot, layer), the bundle's number in truth and how it lies."""

    def __init__(self, seed: int, full: int = 11) -> None:
        self.rng = np.random.default_rng(seed)
        self.lying: dict[tuple[int, int], tuple[int, Laid]] = {}
        self.count = 0
        self.hours = 0
        for slot in self.rng.permutation(SLOTS)[:full]:
            self.deliver((int(slot), 0))
        for slot in [s for s, _ in list(self.lying)][::3]:
            self.deliver((slot, 1))

    def deliver(self, place: tuple[int, int], kind: Laid | None = None) -> int:
        """A new bundle, of a drawn kind where none is given."""
        bars, diameter = KINDS[self.rng.integers(len(KINDS))]
        new = Laid(0, 0, 0, 0, diameter, bars, float(self.rng.choice(LENGTHS_M)), roll_deg=0.0)
        self.count += 1
        self.lay(place, self.count, kind or new)
        return self.count

    def lay(self, place: tuple[int, int], number: int, one: Laid) -> None:
        slot, layer = place
        half = replace(one, z_m=0.0).top_z_m
        below = self.lying[slot, 0][1].top_z_m if layer else 0.0
        x, y, yaw = self.rng.normal(0, (0.03, 0.15, 0.4))
        self.lying[place] = (
            number, replace(one, x_m=PITCH_M * slot + x, y_m=y, yaw_deg=yaw, z_m=below + half),
        )  # fmt: skip

    def covered(self, place: tuple[int, int]) -> bool:
        return place[1] == 0 and (place[0], 1) in self.lying

    def free(self, view: View) -> list[tuple[int, int]]:
        """Empty places on the floor in view."""
        return [(slot, 0) for slot in range(SLOTS) if (slot, 0) not in self.lying and view.sees(slot)]

    def liftable(self, view: View) -> list[tuple[int, int]]:
        return [place for place in self.lying if not self.covered(place) and view.sees(place[0])]

    def survey(self, folder: Path, view: View = WHOLE, never_missed: tuple[int, ...] = ()) -> dict[int, int]:
        """Write a measured folder an hour after the last one; return truth's number by id in bundles.json."""
        folder.mkdir(parents=True)
        self.hours += 1
        shared = self.rng.normal(0, (0.006, 0.006, 0.002))
        bundles, truth = [], {}
        for place, (number, one) in sorted(self.lying.items()):
            seen = view.sees(place[0]) and not self.covered(place)
            if seen and (number in never_missed or self.rng.random() > MISSED):
                truth[len(bundles)] = number
                bundles.append(self._measured(one, len(bundles), shared, view))
        stamps = np.array([START_NS + (3600 * self.hours + k) * NS_PER_S for k in range(3)], np.int64)
        write_heights(self._heights(view, float(shared[2])), folder / "height.tif")
        told = {"captured_from_ns": int(stamps[0]), "captured_to_ns": int(stamps[-1]), "agreement": []}
        content = summary() | told | {"travel": sure_travel(np.zeros((3, 2)), stamps).content()}
        identity = seal_map(content, folder)
        (folder / "result.json").write_text(json.dumps(content), encoding="utf-8")
        write_bundles(tuple(bundles), None, "yard", identity, folder / "bundles.json")
        return truth

    def _measured(self, one: Laid, number: int, shared: np.ndarray, view: View) -> Bundle:
        """As found, with noise of the stated sigmas; an end beyond the view is open."""
        draw = self.rng.normal
        ends = np.array([-one.length_m / 2, one.length_m / 2]) + draw(0, SIGMA.length_m / 2**0.5, 2)
        is_open = bool(one.y_m + ends[1] > view.to_y_m)
        if is_open:
            ends[1] = view.to_y_m - one.y_m
        seen = replace(
            one, x_m=one.x_m + draw(0, SIGMA.lateral_m) + shared[0], y_m=one.y_m + ends.mean() + shared[1],
            yaw_deg=one.yaw_deg + np.degrees(draw(0, SIGMA.yaw_rad)), length_m=float(ends[1] - ends[0]),
        )  # fmt: skip
        return record(
            seen, number, ends_open=(False, is_open),
            top_z_m=one.top_z_m + draw(0, SIGMA.top_z_m) + shared[2],
            width_m=one.width_m + draw(0, SIGMA.width_m),
            bar_diameter_m=one.diameter_m + draw(0, SIGMA.bar_diameter_m),
        )  # fmt: skip

    def _heights(self, view: View, shift_m: float) -> HeightMap:
        xs = np.arange(-0.7, PITCH_M * SLOTS, CELL_M)
        ys = np.arange(-4.0, 4.0, CELL_M)
        x, y = np.meshgrid(xs, ys)
        z = np.zeros(x.shape)
        for _, one in self.lying.values():
            near = np.abs(xs - one.x_m) < 0.5
            z[:, near] = np.maximum(z[:, near], one.over(x[:, near], y[:, near]))
        z += self.rng.normal(0, 0.004, z.shape) + shift_m
        known = (x > view.from_x_m) & (x < view.to_x_m) & (y < view.to_y_m)
        z = np.where(known, z, np.nan).astype(np.float32)
        full = np.full_like(z, 4.0)
        return HeightMap(float(xs[0]), float(ys[0]), CELL_M, z, full / 1000, full, known.astype(np.uint8))
