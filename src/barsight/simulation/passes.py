"""Simulate several passes over one yard: trolley positions, directions, changes in between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from barsight.core.files import atomic_directory
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.travel import PassesSettings
from barsight.simulation.simulate import LaidYard, World, lay_stock, simulate, stream
from barsight.simulation.stock import StackedBundle, Stock, covers, stack_yard

MOVED_M = 0.5


@dataclass(frozen=True, eq=False)
class ChangedStock:
    """A yard before and after a change. rows: content of truth/changes.json."""

    before: LaidYard
    after: LaidYard
    rows: list[dict[str, Any]]


def simulate_passes(
    out: Path, settings: SimulationSettings, progress: Callable[[int, int], None] | None = None,
    laid: LaidYard | None = None,
) -> None:  # fmt: skip
    """Write a recording for each pass of `settings.passes` to the new folder `out`: pass_1, pass_2 and so on.

    laid: a yard that doesn't change, instead of a stock drawn from the seed. truth/changes.json of the last
    pass lists what changed before it.
    """
    wanted = settings.passes
    yard = _unchanged(laid) if laid is not None else _draw_changes(settings)
    count, begin_s = len(wanted.trolley_y_m), settings.motion.begin_s
    with atomic_directory(out) as folder:
        for number, y_m in enumerate(wanted.trolley_y_m):
            own = replace(
                settings,
                passes=PassesSettings(),
                camera=replace(settings.camera, trolley_y_m=y_m),
                motion=replace(
                    settings.motion, begin_s=begin_s,
                    backward=settings.motion.backward ^ (wanted.alternate and number % 2 == 1),
                ),
            )  # fmt: skip
            is_last = number == count - 1
            here = yard.after if is_last else yard.before
            if is_last and yard.rows:
                here = replace(here, truth={**here.truth, "changes.json": yard.rows})

            def advance(done: int, total: int, first: int = number * settings.frames) -> None:
                if progress is not None:
                    progress(first + done, count * total)

            simulate(folder / f"pass_{number + 1}", own, advance, here, number)
            begin_s = World.over(here, own, number).trajectory.duration_s + wanted.pause_s


def _unchanged(laid: LaidYard) -> ChangedStock:
    return ChangedStock(laid, laid, [])


def _draw_changes(settings: SimulationSettings) -> ChangedStock:
    """Draw the bundles of the stock that change: each lies on top, and no two are neighbours."""
    stock, rng = stack_yard(settings, stream(settings, 0)), stream(settings, 20)
    free = [k for k, bundle in enumerate(stock.bundles) if bundle.on_top]
    before, after, rows = set[int](), set[int](), []
    bundles = list(stock.bundles)
    for kind in settings.passes.changes:
        if not free:
            break
        chosen = int(rng.choice(free))
        bundle = stock.bundles[chosen]
        free = [k for k in free if not _beside(stock.bundles[k], bundle)]
        row = {"kind": kind, "center": bundle.centre_m.tolist(), "length": bundle.length_m,
               "radius": bundle.radius_m}  # fmt: skip
        if kind == "added":
            before.add(chosen)
        elif kind == "taken":
            after.add(chosen)
        else:
            way = MOVED_M * float(rng.choice([-1, 1])) * bundle.axes[1]
            bundles[chosen] = replace(bundle, centre_m=bundle.centre_m + way)
            row["moved"] = way.tolist()
        rows.append(row)
    moved = replace(stock, bundles=tuple(bundles))
    return ChangedStock(_lay(stock, before, settings), _lay(moved, after, settings), rows)


def _beside(one: StackedBundle, other: StackedBundle) -> bool:
    return one.section == other.section and abs(one.column - other.column) < 2


def _lay(stock: Stock, gone: set[int], settings: SimulationSettings) -> LaidYard:
    """Lay a stock without the bundles in `gone`; those that they covered are then on top."""
    there = [b for k, b in enumerate(stock.bundles) if k not in gone]
    bundles = tuple(
        replace(b, on_top=b.on_top or not any(covers(o, b) for o in there)) if gone else b
        for b in stock.bundles
    )
    return lay_stock(replace(stock, bundles=bundles), settings, gone)
