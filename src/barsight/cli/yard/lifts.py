"""Run `barsight lifts OUT --magnet FILE`."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from barsight.cli.arguments import call, config_path, load_settings
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import MEASURE_AGAIN, ConfigError, Failed, InputError
from barsight.core.files import changed_folder
from barsight.core.parallel import in_background
from barsight.pipeline.further_passes import find_unseen
from barsight.report.page import draw_pictures, write_report
from barsight.result_folder import (
    PHOTO,
    bundles_digest,
    changed_inputs,
    next_sequence,
    open_folder,
    read_heights,
)
from barsight.yard.events import YardEvent, kept_events, lift_of, merged, read_events, write_events
from barsight.yard.identity import MapIdentity
from barsight.yard.inventory.bundle_file import read_bundles, read_match
from barsight.yard.inventory.stock_list import contradicted_bundles
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.lift_file import write_lifts
from barsight.yard.lifting.order import LiftOrder, begin_order, order_lifts
from barsight.yard.lifting.targets import LiftPlan, map_vetoes, offset_vetoes, plan_lifts
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.description import Magnet, load_magnet
from barsight.yard.types import Bundle, YardMap
from barsight.yard.vetoes import Veto

OTHER_UNIT = 500
"""Ratio of the first frame's stamp to an event's stamp above which the event is refused as stamped in us,
ms or s.
"""
FETCH_REMEDY = "fetch another one, or measure again once its cause is gone"


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, choose the lifts, write and print them."""
    default = load_settings(config_path(arguments), LiftSettings)

    def command(
        out: tyro.conf.Positional[Path],
        magnet: Path | None = None,
        settings: Annotated[LiftSettings, tyro.conf.arg(name="")] = default,
        config: Path | None = None,
        at: Literal["now", "end"] = "now",
        fetch: Annotated[tuple[int, ...], tyro.conf.arg(metavar="ID[,ID...]")] = (),
        lifted: Annotated[tuple[int, ...], tyro.conf.arg(metavar="ID[,ID...]")] = (),
        events: Path | None = None,
    ) -> None:
        """Choose lift targets again from a measured yard, without measuring it again.

        Writes OUT/lifts.json and OUT/report.html and prints the lifts, safest first.

        Args:
            out: A folder of results from barsight measure.
            magnet: TOML file of the magnet (docs/how-to/describe-a-magnet.md). Without it, none is offered.
            settings: Requirements of a lift.
            config: TOML file with settings; flags take precedence.
            lifted: Bundles that were lifted since the yard was measured; lifts near them are refused. Kept in
                OUT/events.csv, which applies to later runs too.
            events: CSV of other lifts, set-downs and passes of a magnet since then; kept in the same file.
            at: Time at which lifts are judged: now, or the recording's end for review, never for a crane.
            fetch: Wanted bundles. Prints the sequence of lifts that digs out the first of them that can be
                reached; a plant is only offered the first lift of that sequence.
        """
        described, folder = load_magnet(magnet), _open(out)
        _expect_bundles(out, folder, "--lifted", lifted)
        _expect_bundles(out, folder, "--fetch", fetch)
        happened = _events(out, folder, lifted, events)
        now_ns = folder.captured_to_ns if at == "end" and folder.captured_to_ns else time.time_ns()
        vetoes = _vetoes(folder, described, settings, now_ns, has_magnet=magnet is not None)
        with in_background(lambda: draw_pictures(out)) as pictures:
            planned: tuple[YardEvent, ...] | None = None
            while planned != happened:
                planned = happened
                plan = plan_lifts(
                    folder.heights, folder.bundles, described, settings, vetoes, folder.travel, now_ns,
                    events=happened, contradicted=folder.contradicted,
                )  # fmt: skip
                order = _first_order(out, folder, plan, fetch) if fetch else None
                happened = _recorded(out, happened)
            plan = replace(plan, unseen=find_unseen(plan, folder.heights, folder.bundles))
            plan = plan if order is None else begin_order(order, plan, folder.bundles, folder.heights)
        console = SafeConsole(stderr=True)
        digest, sequence = bundles_digest(out), next_sequence(out / "lifts.json", folder.identity)
        with changed_folder(out) as staging:
            write_lifts(
                plan, folder.reference, folder.identity, digest, staging / "lifts.json", sequence, order
            )
            write_report(staging, staging / "report.html", pictures.result())
        print_lifts(plan, console)
        if order is not None:
            print_order(order, console)

    call(command, "lifts", arguments)


@dataclass(frozen=True, eq=False)
class _MeasuredFolder:
    """An opened folder of results. contradicted: as `plan_lifts` takes it."""

    summary: dict[str, Any]
    identity: MapIdentity
    heights: YardMap
    bundles: tuple[Bundle, ...]
    travel: Travel | None
    contradicted: dict[int, str]

    @property
    def reference(self) -> str:
        return str(self.summary.get("reference", "world"))

    @property
    def captured_ns(self) -> tuple[int, int] | None:
        return self.travel.captured_ns if self.travel else None

    @property
    def captured_to_ns(self) -> int | None:
        return self.captured_ns[1] if self.captured_ns else None


def _open(out: Path) -> _MeasuredFolder:
    summary, identity = open_folder(out, lifts=False)
    bundles = read_bundles(out / "bundles.json")
    if identity is None:
        raise InputError(out / "result.json", "has no map_id: an earlier version wrote it", MEASURE_AGAIN)
    if PHOTO in summary["files"] and not (out / PHOTO).is_file():
        raise InputError(out / PHOTO, "is missing: nothing else shows labels under a face", MEASURE_AGAIN)
    stock = read_match(out / "bundles.json")
    listed = {} if stock is None else contradicted_bundles(stock)
    return _MeasuredFolder(summary, identity, read_heights(out), bundles, Travel.read(summary), listed)


def _vetoes(
    folder: _MeasuredFolder, magnet: Magnet, settings: LiftSettings, now_ns: int, *, has_magnet: bool
) -> tuple[Veto, ...]:
    """Collect the vetoes that apply to every lift of the map."""
    warnings = [(str(w.get("code")), str(w.get("message"))) for w in folder.summary.get("warnings") or []]
    vetoes = map_vetoes(
        warnings, folder.reference, folder.captured_to_ns, now_ns, settings, has_magnet=has_magnet
    )
    if folder.travel is None:
        unknown = "result.json doesn't say how sure the trajectory is: measure again"
        vetoes = (*vetoes, Veto("trajectory-degraded", unknown))
    vetoes += offset_vetoes(magnet, folder.identity.calibration_id, folder.identity.yard_frame_id)
    changed = changed_inputs(folder.summary)
    if changed:
        vetoes = (*vetoes, Veto("calibration-changed", f"{changed} was changed since: measure again"))
    return vetoes


def _first_order(out: Path, folder: _MeasuredFolder, plan: LiftPlan, wanted: tuple[int, ...]) -> LiftOrder:
    """Find the lift order for the first wanted bundle that can be dug out. Raises InputError where none
    can.
    """
    reasons = []
    for number in wanted:
        order = order_lifts(number, folder.heights, folder.bundles, plan)
        if not isinstance(order, Failed):
            return order
        reasons.append(f"bundle {number} can't be fetched: {order.reason}")
    raise InputError(out, f"no lifts were written, {'; '.join(reasons)}", FETCH_REMEDY)


def print_order(order: LiftOrder, console: Console) -> None:
    """Print the sequence of lifts that digs a bundle out, and that only the first is offered."""
    table = Table(title=f"Lifts that fetch bundle {order.bundle}", box=SIMPLE_HEAD)
    for head in ("step", "bundle", "to x m", "y m", "z m", "yaw deg", "travel z m", ""):
        table.add_column(head, justify="right", no_wrap=True)
    for number, step in enumerate(order.steps, start=1):
        to, state = step.set_down, "offered" if step.is_offered else "to be confirmed"
        table.add_row(
            str(number), str(step.bundle), f"{to.x_m:.3f}", f"{to.y_m:.3f}", f"{to.z_m:.3f}",
            f"{to.yaw_deg:.2f}", f"{step.travel_z_m:.2f}", state,
        )  # fmt: skip
    console.print(table)
    console.print("Measure again after every lift: the next one is a plan, not an offer.", highlight=False)


def _expect_bundles(out: Path, folder: _MeasuredFolder, flag: str, ids: tuple[int, ...]) -> None:
    """Raise ConfigError for an id that no bundle has."""
    known = {bundle.id for bundle in folder.bundles}
    for number in ids:
        if number not in known:
            problem = f"{out / 'bundles.json'} has no such bundle; it has {len(known)}, from 0"
            raise ConfigError(f"{flag} {number}: {problem}")


def _events(
    out: Path, folder: _MeasuredFolder, ids: tuple[int, ...], file: Path | None
) -> tuple[YardEvent, ...]:
    """Collect the events from OUT/events.csv, a file and the ids of lifted bundles."""
    by_id, captured_ns = {bundle.id: bundle for bundle in folder.bundles}, folder.captured_ns
    known, given = kept_events(out), read_events(file) if file is not None else ()
    for path, events in ((out / "events.csv", known), (file, given)):
        for event in events:
            if captured_ns is not None and event.stamp_ns < captured_ns[0] / OTHER_UNIT:
                problem = f"stamp {event.stamp_ns} isn't ns on the frames' clock, which said {captured_ns[0]}"
                raise InputError(path or out, problem, "give stamps in ns, by the clock of the frames")
    return _recorded(out, (*given, *(lift_of(by_id[number], time.time_ns()) for number in ids)))


def _recorded(out: Path, events: tuple[YardEvent, ...]) -> tuple[YardEvent, ...]:
    """Add events to OUT/events.csv; return all that are there.

    They are written before the lifts are chosen, and are looked at again afterwards: another run may have
    added its own meanwhile, and a fetch that fails leaves them.
    """
    known = kept_events(out)
    whole = merged(known, events)
    if whole != known:
        write_events(whole, out / "events.csv")
    return whole


def _offset(magnet: Magnet) -> str:
    """Describe the magnet's offset from where the crane's readings place it."""
    if magnet.offset is None:
        return "the magnet's offset is not calibrated, so its tolerance must cover it (calibrate magnet)"
    return (
        f"the magnet is off the crane's readings by {magnet.offset.words}; crane_target is corrected for this"
    )


def print_lifts(plan: LiftPlan, console: Console) -> None:
    """Print the offered lifts as a table and the vetoes as counts."""
    console.print(f"magnet: {escape(plan.magnet.name)}", highlight=False)
    console.print(_offset(plan.magnet), highlight=False)
    for veto in plan.vetoes:
        console.print(f"[red]{veto.code}:[/red] {escape(veto.reason)}", highlight=False)
    if plan.offered:
        title = "Lifts, safest first"
        if plan.looks_back:
            title += ", at the recording's end: not for a crane"
        table = Table(title=title, box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        heads = (
            "rank", "bundle", "x m", "y m", "yaw deg", "kg", "pull/need", "± mm", "safety",
        )  # fmt: skip
        for head in heads:
            table.add_column(head, justify="right", no_wrap=True)
        for rank, lift in enumerate(plan.offered, start=1):
            assert lift.contact is not None
            table.add_row(
                str(rank), ", ".join(str(b) for b in lift.bundles), f"{lift.place.x_m:.3f}",
                f"{lift.place.y_m:.3f}", f"{lift.place.yaw_deg:.2f}",
                f"{lift.mass.kg:.0f} ± {lift.mass.sigma_kg:.0f}",
                f"{lift.contact.pull_low_n / lift.needed_n:.1f}",
                f"{1e3 * lift.tolerance.x_m:.0f} x {1e3 * lift.tolerance.y_m:.0f}", f"{lift.safety:.2f}",
            )  # fmt: skip
        console.print(table)
    else:
        what = "no bundle was found" if not plan.refused else f"all {len(plan.refused)} places are vetoed"
        console.print(f"no lift is offered: {what}", highlight=False)
    reasons = Counter(code for lift in plan.refused for code in dict.fromkeys(v.code for v in lift.vetoes))
    if reasons:
        listed = ", ".join(f"{code} {count}" for code, count in reasons.most_common())
        console.print(f"refused: {len(plan.refused)} ({listed})", highlight=False)
    for sentence in plan.unseen.sentences if plan.unseen else ():
        console.print(sentence, highlight=False)
