"""Add a measured folder to the store: name its bundles, and find what became of those known before."""

from __future__ import annotations

import json
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.errors import MEASURE_AGAIN, InputError, MeasurementError
from barsight.core.extras import extra
from barsight.core.stamps import NS_PER_S
from barsight.result_folder import file_digest, open_folder, read_heights
from barsight.store.audit import Entry, entry
from barsight.store.calibrations import note_calibration, why_invalid
from barsight.store.confirmation import yard_clock_ns
from barsight.store.history import (
    BundleSighting,
    executed_lifts,
    identity_name,
    newest_absences,
    newest_sightings,
    next_sightings,
)  # fmt: skip
from barsight.store.lift_records import add_lifts, settle_lifts
from barsight.store.matching import FoundBundle, KnownBundle, match_by_place, match_carried
from barsight.store.opening import Store
from barsight.store.recordings import FoundRecording, note_recordings, recordings_of
from barsight.store.tables import ABSENCES, BUNDLES, SIGHTINGS, SURVEY_VETOES, SURVEYS
from barsight.store.touches import end_disturbed
from barsight.yard.events import kept_events
from barsight.yard.identity import MapIdentity, expect_same_frame
from barsight.yard.inventory.bundle_file import bundle_of, bundles_content, read_match
from barsight.yard.inventory.changes import Finding, look_at
from barsight.yard.inventory.coarse_map import pack, unpack, unpack_seen
from barsight.yard.inventory.matching import moved_bundles
from barsight.yard.lifting import lift_file
from barsight.yard.lifting.lift_file import read_lifts, unknown_events
from barsight.yard.lifting.validity import is_ahead
from barsight.yard.types import Bundle, YardMap

with extra("store"):
    from sqlalchemy import Connection, select

REASONS: dict[Finding, str] = {
    "gone": "its place was seen, and it is empty or something else lies there",
    "covered": "something lies over its place",
    "not-found": "something as high lies at its place, but no such bundle was detected",
}


@dataclass(frozen=True)
class AddedSurvey:
    """One survey's place in the yard's history.

    is_new: False if the store already had it. changes: of its bundles by name: `same`, `moved`, `added` (its
    place was empty before), `found` (its place had not been seen, or was covered). absences: of bundles that
    it did not see.
    """

    map_id: str
    is_new: bool
    changes: dict[str, str]
    absences: dict[str, str]

    @property
    def counts(self) -> Counter[str]:
        """Count changes and absences by kind."""
        return Counter([*self.changes.values(), *self.absences.values()])


@dataclass(frozen=True, eq=False)
class MeasuredSurvey:
    """A measured folder, read and checked against its digests.

    from_ns, to_ns: of its frames. records: of bundles.json, without the bars.
    """

    path: Path
    identity: MapIdentity
    from_ns: int
    to_ns: int
    software_version: str
    files: dict[str, str]
    records: tuple[dict[str, Any], ...]
    found: tuple[FoundBundle, ...]
    heights: YardMap
    lifts: dict[str, Any] | None
    recordings: tuple[FoundRecording, ...]


def add_survey(
    store: Store, read: MeasuredSurvey, who: str, *, same_yard: bool = False, rig: str | None = None,
    crane: str | None = None, version: str | None = None,
) -> AddedSurvey:  # fmt: skip
    """Add a survey in one transaction; one that the store already has changes nothing.

    An older survey is inserted at its place in time: its bundles are matched to those seen before it and to
    those first seen after it. same_yard: its placement in the yard may differ from the newest survey's.
    rig, crane: names of the equipment used, by default those of its calibration. version: of a fleet; its
    bundles are matched to the surveys of that version before the version is promoted.

    Raises InputError if simulated and measured surveys, or surveys of two yard frames, would mix.
    """
    heights = pack(read.heights)
    with entry(store, who, f"survey {read.identity.map_id}") as opened:
        if not _expect_new(opened.connection, read):
            return AddedSurvey(read.identity.map_id, False, {}, {})
        if not same_yard:
            _expect_same_frame(opened.connection, read)
        known, last = _known(opened.connection, read, version)
        matched = match_by_place(known, read.found, read.heights)
        partner = {j: i for i, j in matched.found.items()}
        before = {j: last[known[i].bundle_id] for j, i in partner.items() if known[i].bundle_id in last}
        shown = _shown_before(opened.connection, read, set(range(len(read.found))) - set(before))
        # A bundle that was covered was not put there since.
        laid = [j for j, finding in shown.items() if j not in partner and finding != "covered"]
        carried = match_carried(known, read.found, matched, laid)
        partner |= {j: i for i, j in carried.items()}
        moved = moved_bundles(list(before.values()), [read.found[j].bundle for j in before])
        findings = {j: "added" if finding == "gone" else "found" for j, finding in shown.items()}
        findings |= {j: "moved" if is_moved else "same" for j, is_moved in zip(before, moved, strict=True)}
        findings |= dict.fromkeys(carried.values(), "moved")
        survey_id = _add_row(opened, read, heights)
        changes: dict[int, str] = {}
        ids: dict[int, int] = {}
        for j, found in enumerate(read.found):
            number = known[partner[j]].bundle_id if j in partner else opened.add(BUNDLES, survey_id=survey_id)
            _add_sighting(opened, survey_id, number, findings[j], found, read.records[j])
            changes[number], ids[found.bundle.id] = findings[j], number
        absences = {
            known[i].bundle_id: finding
            for i, finding in matched.findings.items()
            if i not in carried and finding != "unseen" and known[i].last is not None
        }
        for number, finding in absences.items():
            opened.add(ABSENCES, survey_id=survey_id, bundle_id=number, kind=finding, reason=REASONS[finding])
        is_newest = not next_sightings(opened.connection, read.to_ns)
        settle_lifts(opened, changes | absences, read.from_ns, is_newest=is_newest)
        is_valid = _note_equipment(opened, read, survey_id, (rig, crane))
        if read.lifts is not None:
            is_sound = is_valid and not _note_looking_back(opened, read, survey_id, version)
            add_lifts(opened, survey_id, read.lifts, ids, is_newest=is_newest and is_sound)
            if is_newest:
                end_disturbed(opened, read.from_ns)
    named = {identity_name(number): change for number, change in changes.items()}
    return AddedSurvey(
        read.identity.map_id, True, named, {identity_name(n): kind for n, kind in absences.items()}
    )


def read_survey(folder: Path) -> MeasuredSurvey:
    """Open a measured folder, with every file checked against its digest.

    Raises InputError for a folder that was changed or has no bundles or times, MeasurementError if its map
    has no place in the yard.
    """
    folder = folder.resolve()  # a link such as `latest` leads elsewhere later
    summary, identity = open_folder(folder, cloud=True)
    path = folder / "bundles.json"
    if identity is None or not path.is_file():
        raise InputError(folder, "has no bundles.json", MEASURE_AGAIN)
    if summary.get("reference") != "yard":
        raise MeasurementError(
            f"{folder}: is in the {summary.get('reference')} frame; only maps with a crane's place are kept"
        )
    if identity.captured_from_ns is None or identity.captured_to_ns is None:
        raise InputError(folder / "result.json", "has no captured_from_ns and captured_to_ns", MEASURE_AGAIN)
    content = bundles_content(path)
    records = tuple({k: v for k, v in one.items() if k != "bar_axes"} for one in content["bundles"])
    match = read_match(path)
    matched = () if match is None else (one for one in match.matched if one.name not in match.moved)
    names = {one.bundle: one.name for one in matched if not one.disagrees}
    found = tuple(FoundBundle(bundle_of(one), names.get(one["id"])) for one in records)
    chosen = folder / "lifts.json"
    own = {name: file_digest(folder / name) for name in ("result.json", "bundles.json")}
    lifts = read_lifts(chosen) if chosen.is_file() else None
    if lifts is not None:
        own["lifts.json"] = file_digest(chosen)
        if unknown_events(lifts, kept_events(folder)):
            raise InputError(chosen, "was chosen before the newest of events.csv", lift_file.REMEDY)
    return MeasuredSurvey(
        folder, identity, identity.captured_from_ns, identity.captured_to_ns,
        str((summary.get("software") or {}).get("version")), {**summary["files"], **own}, records, found,
        read_heights(folder), lifts, recordings_of(summary),
    )  # fmt: skip


def _expect_new(connection: Connection, read: MeasuredSurvey) -> bool:
    """Check that the store has no such map. Raises InputError if simulated and real ones would mix, or if
    the frames are ahead of this computer's clock: such a survey would stay the newest until then.
    """
    kinds = select(SURVEYS.c.is_simulated).limit(1)
    simulated = connection.execute(kinds).scalar()
    if simulated is not None and simulated != read.identity.is_simulated:
        words = ("was measured", "simulated") if simulated else ("is simulated", "measured")
        raise InputError(
            read.path, f"{words[0]}, the store holds {words[1]} surveys", "keep it in a store of its own"
        )
    same = select(SURVEYS.c.id).where(SURVEYS.c.map_id == read.identity.map_id)
    if connection.execute(same).first() is not None:
        return False
    if is_ahead(read.to_ns, now_ns := time.time_ns()) and not read.identity.is_simulated:
        ahead = f"its last frame is {(read.to_ns - now_ns) / NS_PER_S:.0f} s ahead of this computer's clock"
        raise InputError(read.path, ahead, "set the clocks and survey again")
    return True


def _expect_same_frame(connection: Connection, read: MeasuredSurvey) -> None:
    newest = select(SURVEYS.c.yard_frame_id).order_by(SURVEYS.c.captured_to_ns.desc()).limit(1)
    known = connection.execute(newest).scalar()
    expect_same_frame(read.path, read.identity.yard_frame_id, known, "the store's newest survey")


def _shown_before(connection: Connection, read: MeasuredSurvey, new: set[int]) -> dict[int, Finding]:
    """Find what the newest earlier survey that saw a bundle's place saw there. new: positions in
    `read.found`.
    """
    findings: dict[int, Finding] = dict.fromkeys(new, "unseen")
    earlier = (
        select(SURVEYS.c.id)
        .where(SURVEYS.c.captured_to_ns <= read.to_ns)
        .order_by(SURVEYS.c.captured_to_ns.desc(), SURVEYS.c.id.desc())
    )
    for survey_id in connection.execute(earlier).scalars().all():
        unseen = {j: read.found[j].bundle for j, finding in findings.items() if finding == "unseen"}
        if not unseen:
            break
        packed = connection.execute(select(SURVEYS.c.heights).where(SURVEYS.c.id == survey_id)).scalar_one()
        area = unpack_seen(packed)
        shown = {j: bundle for j, bundle in unseen.items() if look_at(bundle, area) != "unseen"}
        if shown:
            heights = unpack(packed)
            findings |= {j: look_at(bundle, heights) for j, bundle in shown.items()}
    return findings


def _add_row(opened: Entry, read: MeasuredSurvey, heights: bytes) -> int:
    identity = read.identity
    return opened.add(
        SURVEYS, map_id=identity.map_id, captured_from_ns=read.from_ns, captured_to_ns=read.to_ns,
        added_ns=opened.at_ns, calibration_id=identity.calibration_id, yard_frame_id=identity.yard_frame_id,
        is_simulated=identity.is_simulated, software_version=read.software_version, folder=str(read.path),
        files=json.dumps(read.files, sort_keys=True), heights=heights,
    )  # fmt: skip


def _known(
    connection: Connection, read: MeasuredSurvey, version: str | None
) -> tuple[tuple[KnownBundle, ...], dict[int, Bundle]]:
    """Collect the bundles in the yard before this survey or first seen after it; and the former as last
    seen.
    """
    before = newest_sightings(connection, read.to_ns, version)
    after = next_sightings(connection, read.to_ns, version)
    absences = newest_absences(connection, read.to_ns, version)
    lifts = {each.bundle_id: each for each in executed_lifts(connection)}
    known, last = [], {}
    for number in sorted({*before, *after}):
        seen: BundleSighting | None = before.get(number)
        absent = absences.get(number)
        is_gone = bool(seen and absent and absent.kind == "gone" and absent.looked_ns >= seen.seen_ns)
        if is_gone and number not in after:
            continue
        place = None if seen is None or is_gone else seen.bundle
        later = after[number].bundle if number in after else None
        lift = lifts.get(number)
        is_lifted = bool(
            lift and place and seen and lift.state != "failed"
            and seen.seen_ns < lift.executed_ns <= read.to_ns
        )  # fmt: skip
        laid = lift.laid(place) if lift and place and is_lifted else None
        name = (seen or after[number]).stock_name
        known.append(KnownBundle(number, place, later, name, is_lifted, laid))
        if seen is not None:
            last[number] = seen.bundle
    return tuple(known), last


def _note_equipment(
    opened: Entry, read: MeasuredSurvey, survey_id: int, named: tuple[str | None, str | None]
) -> bool:
    """Add rig, calibration and recordings of a survey; return whether the calibration is valid now.

    If it isn't, the map's lifts are forbidden.
    """
    digest = read.identity.calibration_id
    rig = note_calibration(opened, digest, *named)
    note_recordings(opened, read.recordings, rig, (survey_id, read.identity.map_id))
    reason = why_invalid(opened.connection, digest, yard_clock_ns(opened.connection))
    if reason:
        opened.add(SURVEY_VETOES, survey_id=survey_id, code="calibration-changed", reason=reason)
    return not reason


def _note_looking_back(opened: Entry, read: MeasuredSurvey, survey_id: int, version: str | None) -> bool:
    """Return True, and forbid the lifts, if they were judged as of the last frame, as those of a fleet's
    version are: their age was not compared with a clock. A simulated yard's clock continues from that frame.
    """
    looks_back = read.lifts is not None and read.lifts["looks_back"] and not read.identity.is_simulated
    if version is None and not looks_back:
        return False
    reason = "its lifts were judged at the time of the last frame, for review only, never for a crane"
    opened.add(SURVEY_VETOES, survey_id=survey_id, code="map-too-old", reason=reason)
    return True


def _add_sighting(
    opened: Entry, survey_id: int, bundle_id: int, change: str, found: FoundBundle, record: dict[str, Any]
) -> None:
    x_m, y_m, _ = record["axis_centre_m"]
    figures = {name: record[name] for name in ("top_z_m", "yaw_deg", "length_m", "width_m")}
    opened.add(
        SIGHTINGS, survey_id=survey_id, bundle_id=bundle_id, number=record["id"], change=change,
        stock_name=found.stock_name, x_m=x_m, y_m=y_m, **figures, record=json.dumps(record, sort_keys=True),
    )  # fmt: skip
