"""Read and write `lifts.json`: the ranked lift targets and the refused ones."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cattrs
import numpy as np

from barsight.core.json_values import DIGITS, json_value
from barsight.core.reading.json_schema import expect_schema, package_schema
from barsight.core.reading.sealed_json import read_sealed, write_sealed
from barsight.yard.events import YardEvent
from barsight.yard.identity import MapIdentity
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.bearing import magnet_reach
from barsight.yard.lifting.lift import Lift, UnseenPlaces
from barsight.yard.lifting.order import LiftOrder
from barsight.yard.lifting.targets import RULE, LiftPlan
from barsight.yard.lifting.validity import disturbed_checks, is_ahead
from barsight.yard.magnet.description import Magnet, MagnetOffset
from barsight.yard.magnet.footprint import Placement
from barsight.yard.placement.load import Load, laid_at
from barsight.yard.stability.stability import Footing
from barsight.yard.types import Bundle
from barsight.yard.vetoes import Veto, vetoes_of

SCHEMA_VERSION = 2
REMEDY = "run barsight lifts on the folder"


def write_lifts(
    plan: LiftPlan, reference: str, identity: MapIdentity, bundles_sha256: str, target: Path,
    sequence: int = 1, order: LiftOrder | None = None,
) -> str:  # fmt: skip
    """Write lifts.json completely or not at all; return its digest. reference: the frame, `yard` or `world`.
    bundles_sha256: the digest in bundles.json.
    """
    return write_sealed(lifts_content(plan, reference, identity, bundles_sha256, sequence, order), target)


def read_lifts(path: Path) -> dict[str, Any]:
    """Read lifts.json. Raises InputError where it is missing, truncated, altered, of another version or
    doesn't match its schema.
    """
    content = read_sealed(path, SCHEMA_VERSION, REMEDY)
    expect_schema(content, package_schema("barsight.yard", "lifts"), path, REMEDY)
    return content


def read_unseen(content: dict[str, Any]) -> UnseenPlaces | None:
    """Read what was not seen of refused lifts from the content of lifts.json; None if it doesn't tell."""
    unseen = content.get("unseen")
    return None if unseen is None else cattrs.structure(unseen, UnseenPlaces)


def forbidden_since(
    content: dict[str, Any], record: dict[str, Any], bundles: Iterable[Bundle],
    events: tuple[YardEvent, ...], now_ns: int,
) -> tuple[Veto, ...]:  # fmt: skip
    """List what has forbidden a lift since it was offered: its age, and events near it or near its set-down.

    content: of lifts.json; record: one of its lifts. bundles, events: of the same folder. now_ns: on the
    frames' clock.
    """
    found, target = [], record["target"]
    until_ns, seen_ns = record["valid_until_ns"], record["valid_from_ns"]
    if (until_ns or 0) < now_ns:
        found.append(Veto("map-too-old", "the lift is no longer valid"))
    elif is_ahead(seen_ns, now_ns):
        found.append(
            Veto(
                "map-from-the-future", "the frames are ahead of this computer's clock: synchronise the clocks"
            )
        )
    magnet = cattrs.structure(content["magnet"], Magnet)
    settings = cattrs.structure(content["settings"], LiftSettings)
    load = tuple(bundle for bundle in bundles if bundle.id in record["bundles"])
    later = unknown_events(content, events)
    checks = disturbed_checks(later, _placement(target), magnet, load, None, settings)
    if record["set_down"] is not None and not vetoes_of(checks):
        place = _placement(record["set_down"])
        laid = laid_at(load, place.x_m, place.y_m, place.yaw_rad)
        wide, long = np.maximum((laid.width_m, laid.length_m), 2 * magnet_reach(Load.of(load), magnet))
        laid = replace(laid, width_m=float(wide), length_m=float(long))
        checks = disturbed_checks(later, place, magnet, (laid,), None, settings)
    return (*found, *vetoes_of(checks))


def unknown_events(content: dict[str, Any], events: tuple[YardEvent, ...]) -> tuple[YardEvent, ...]:
    """Select the events that the map may not show and that weren't known when lifts.json was written."""
    from_ns, known = content["captured_from_ns"] or -1, content["events"]
    return tuple(
        one for one in events if one.stamp_ns > from_ns and json_value(asdict(one), DIGITS) not in known
    )


def _placement(place: dict[str, float]) -> Placement:
    return Placement(place["x_m"], place["y_m"], math.radians(place["yaw_deg"]))


def lifts_content(
    plan: LiftPlan, reference: str, identity: MapIdentity, bundles_sha256: str, sequence: int = 1,
    order: LiftOrder | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Build the content of lifts.json, without its digest. order: the one that digs out the requested bundle,
    if there is one.
    """
    offset = plan.magnet.offset
    content: dict[str, Any] = json_value(
        {
            "schema_version": SCHEMA_VERSION,
            **identity.header(sequence),
            "bundles_sha256": bundles_sha256,
            "reference": reference,
            "judged_at_ns": plan.judged_at_ns,
            "looks_back": plan.looks_back,
            "rule": RULE,
            "events": [asdict(event) for event in plan.events],
            "magnet": asdict(plan.magnet),
            "settings": asdict(plan.settings),
            "vetoes": _vetoes(plan.vetoes),
            "lifts": [_lift(lift, rank, offset) for rank, lift in enumerate(plan.offered, start=1)],
            "refused": [_lift(lift, None, offset) for lift in plan.refused],
            "footings": [_footing(footing) for footing in plan.footings],
            "sides": [asdict(side) for side in plan.sides],
            "blocked": [asdict(each) for each in plan.blocked],
            "fetch": asdict(order) if order else None,
            "unseen": asdict(plan.unseen) if plan.unseen else None,
        },
        DIGITS,
    )
    return content


def _lift(lift: Lift, rank: int | None, offset: MagnetOffset | None) -> dict[str, Any]:
    contact, place = lift.contact, lift.place
    height = contact.centre_z_m if contact else None
    put, over = lift.set_down, lift.magnet_down
    return {
        "rank": rank,
        "target": {
            "x_m": place.x_m,
            "y_m": place.y_m,
            "z_m": height,
            "yaw_deg": math.degrees(place.yaw_rad),
        },
        "crane_target": _crane(place.x_m, place.y_m, height, math.degrees(place.yaw_rad), offset),
        "bundles": lift.bundles,
        "count": lift.count,
        "count_probability": lift.count_probability,
        "straddled": lift.straddled,
        "tolerance": asdict(lift.tolerance),
        "valid_from_ns": lift.validity.from_ns if lift.validity else None,
        "valid_until_ns": lift.validity.until_ns if lift.validity else None,
        "safety": lift.safety,
        "mass_kg": lift.mass.kg,
        "mass_sigma_kg": lift.mass.sigma_kg,
        "pull_n": contact.pull_n if contact else None,
        "pull_low_n": contact.pull_low_n if contact else None,
        "pull_needed_n": lift.needed_n,
        "pitch_deg": math.degrees(contact.pitch_rad) if contact else None,
        "roll_deg": math.degrees(contact.roll_rad) if contact else None,
        "contact_sigma_m": contact.sigma_m if contact else None,
        "contact_share": contact.contact_share if contact else None,
        "offset_along_m": lift.offset_along_m,
        "offset_across_m": lift.offset_across_m,
        "overhang_m": lift.overhang_m,
        "poles": [
            {
                "z_m": pole.z_m,
                "mean_gap_m": pole.gap_m,
                "least_gap_m": pole.min_gap_m,
                "contact_share": pole.contact_share,
                "unknown_share": pole.unknown_share,
                "pull_n": pole.pull_n,
                "gap_map_m": [[_rounded(gap) for gap in row] for row in pole.gap_map_m.T.tolist()],
            }
            for pole in (contact.poles if contact else ())
        ],
        "target_covariance": None if lift.covariance is None else lift.covariance.tolist(),
        "set_down": asdict(put) if put else None,
        "crane_set_down": _crane(over.x_m, over.y_m, put.z_m, math.degrees(over.yaw_rad), offset)
        if put and over
        else None,
        "checks": [asdict(check) for check in lift.checks],
        "vetoes": _vetoes(lift.vetoes),
    }


def _crane(
    x_m: float, y_m: float, z_m: float | None, yaw_deg: float, offset: MagnetOffset | None
) -> dict[str, float | None]:
    """Return what the crane's readings must be for the magnet to be at a place; the place itself where no
    offset is known.
    """
    off = np.zeros(3) if offset is None else offset.place_m(math.radians(yaw_deg))
    height = None if z_m is None else z_m - off[2]
    return {"x_m": x_m - off[0], "y_m": y_m - off[1], "z_m": height, "yaw_deg": yaw_deg}


def _vetoes(vetoes: tuple[Veto, ...]) -> list[dict[str, str]]:
    return [asdict(veto) for veto in vetoes]


def _footing(footing: Footing) -> dict[str, Any]:
    return {
        "bundle": footing.bundle,
        "overhang_m": footing.overhang_m,
        "overhang_side": footing.overhang_side,
        "lean_deg": footing.lean_deg,
        "freeboard_m": footing.freeboard_m,
        "sides": [asdict(side) for side in footing.sides],
    }


def _rounded(metres: float) -> float | None:
    return round(metres, 4) if math.isfinite(metres) else None
