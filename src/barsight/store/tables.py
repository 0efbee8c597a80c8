"""Define the store's tables: facts that are added and never changed or removed.

Times are integers in ns on the frames' clock (`captured_*`) or this computer's clock (`at_ns`, `added_ns`).
"""

from __future__ import annotations

from barsight.core.extras import extra

with extra("store"):
    from sqlalchemy import (
        BigInteger,
        Boolean,
        Column,
        Double,
        ForeignKey,
        Integer,
        LargeBinary,
        MetaData,
        Table,
        Text,
        UniqueConstraint,
    )  # fmt: skip

METADATA = MetaData()
MAX_ID = 2**31 - 1
"""Largest id; a query for a larger one is an error in PostgreSQL."""


def _figures(*names: str) -> list[Column[float]]:
    return [Column(name, Double, nullable=False) for name in names]


def _texts(*names: str) -> list[Column[str]]:
    return [Column(name, Text, nullable=False) for name in names]


def _stamps(*names: str) -> list[Column[int]]:
    return [Column(name, BigInteger, nullable=False) for name in names]


def _of(table: str, *, is_optional: bool = False) -> Column[int]:
    name = f"{table.removesuffix('s')}_id"
    return Column(name, Integer, ForeignKey(f"{table}.id"), nullable=is_optional, index=True)


def _key() -> Column[int]:
    return Column("id", Integer, primary_key=True)


SURVEYS = Table(
    "surveys", METADATA, _key(), Column("map_id", Text, nullable=False, unique=True),
    *_stamps("captured_from_ns", "captured_to_ns", "added_ns"), *_texts("calibration_id"),
    Column("yard_frame_id", Text), Column("is_simulated", Boolean, nullable=False),
    *_texts("software_version", "folder", "files"), Column("heights", LargeBinary, nullable=False),
)  # fmt: skip
"""Measured folders. files: JSON with SHA-256 of each file. heights: from `coarse_map.pack`."""
SURVEY_FACTS = tuple(column for column in SURVEYS.c if column.name != "heights")
"""Columns of a survey but for its heights, which fill the memory where many surveys are read."""

BUNDLES = Table("bundles", METADATA, _key(), _of("surveys"))
"""Identities: one row for each bundle that was ever in the yard, with the survey that named it."""

SIGHTINGS = Table(
    "sightings", METADATA, _key(), _of("surveys"), _of("bundles"),
    Column("number", Integer, nullable=False), *_texts("change"), Column("stock_name", Text),
    *_figures("x_m", "y_m", "top_z_m", "yaw_deg", "length_m", "width_m"), *_texts("record"),
    UniqueConstraint("survey_id", "number"), UniqueConstraint("survey_id", "bundle_id"),
)  # fmt: skip
"""Bundles as a survey saw them. number: id in bundles.json; record: its JSON there, without `bar_axes`."""

ABSENCES = Table(
    "absences", METADATA, _key(), _of("surveys"), _of("bundles"), *_texts("kind", "reason"),
    UniqueConstraint("survey_id", "bundle_id"),
)  # fmt: skip
"""Bundles that a survey looked for and did not see: `gone`, `covered` or `not-found`."""

LIFTS = Table(
    "lifts", METADATA, _key(), _of("surveys"), Column("rank", Integer, nullable=False), *_texts("record"),
)  # fmt: skip
"""Lifts that a survey's lifts.json offered. record: its JSON there, without poles and checks."""

LIFT_BUNDLES = Table(
    "lift_bundles", METADATA, _key(), _of("lifts"), _of("bundles"), UniqueConstraint("lift_id", "bundle_id")
)

LIFT_STATES = Table(
    "lift_states", METADATA, _key(), _of("lifts"), Column("step", Integer, nullable=False),
    *_texts("state"), *_stamps("at_ns"), *_texts("who"), Column("note", Text),
    UniqueConstraint("lift_id", "step"),
)  # fmt: skip

TOUCHES = Table(
    "touches", METADATA, _key(), _of("lifts", is_optional=True), *_texts("kind"),
    *_figures("x_m", "y_m", "z_m"), *_stamps("at_ns"), *_texts("who"),
)  # fmt: skip
"""Places by the crane's readings where its magnet touched something; see `touches`. lift_id: of the lift that
it belongs to.
"""

SURVEY_VETOES = Table(
    "vetoes", METADATA, _key(), _of("surveys"), _of("bundles", is_optional=True), *_texts("code", "reason"),
)  # fmt: skip
"""Vetoes of a survey's lifts.json; without a bundle they apply to the whole map."""

ALARMS = Table("alarms", METADATA, _key(), *_texts("code", "reason"))

ALARM_STATES = Table(
    "alarm_states", METADATA, _key(), _of("alarms"), Column("step", Integer, nullable=False),
    *_texts("state"), *_stamps("at_ns"), *_texts("who"), Column("note", Text),
    UniqueConstraint("alarm_id", "step"),
)  # fmt: skip

ACCOUNTS = Table(
    "accounts", METADATA, _key(), *_texts("name", "kind", "role", "secret"), *_stamps("at_ns"),
    *_texts("who"),
)  # fmt: skip
"""Accounts that may use the page; for each name the newest row counts. kind: `person` or `token`; see
`accounts`.
"""

STOCK_DECISIONS = Table(
    "stock_decisions", METADATA, _key(), _of("surveys"), *_texts("difference", "decision"),
    *_stamps("at_ns"), *_texts("who"), Column("note", Text),
)  # fmt: skip
"""Decisions on a difference between a survey and its stock list; for each difference the newest row
counts.
"""

AUDIT = Table(
    "audit", METADATA, _key(), *_stamps("at_ns"), *_texts("who", "what", "content"),
    Column("previous", Text, nullable=False, unique=True), Column("digest", Text, nullable=False),
)  # fmt: skip
"""The chain of additions; see `audit`."""

FLEET_VERSIONS = Table(
    "fleet_versions", METADATA, _key(), Column("name", Text, nullable=False, unique=True),
    *_texts("configuration", "calibration", "magnet", "software", "rig"), *_stamps("at_ns"),
)  # fmt: skip
"""Versions for measuring an archive; for the digests see `fleet.versions`."""

FLEET_TASKS = Table(
    "fleet_tasks", METADATA, _key(), Column("key", Text, nullable=False, unique=True),
    *_texts("version", "archive", "recording", "passes"), *_stamps("bytes", "pairs", "at_ns"),
)  # fmt: skip
"""Recordings planned for a version. key: of `fleet.versions.Version.key`; passes: JSON; archive, recording:
where it was first found.
"""

FLEET_PLACES = Table(
    "fleet_places", METADATA, _key(), Column("key", Text, nullable=False, index=True),
    *_texts("manifest", "archive", "recording"), *_stamps("at_ns"),
)  # fmt: skip
"""Places of a task's recording; for each key the newest row counts. manifest: digest of its files."""

FLEET_RESULTS = Table(
    "fleet_results", METADATA, _key(), Column("key", Text, nullable=False, unique=True),
    *_figures("measured_s", "whole_s"), *_stamps("peak_bytes", "result_bytes", "at_ns"),
)  # fmt: skip
"""Completed tasks; the results' own objects are authoritative."""

FLEET_SURVEYS = Table(
    "fleet_surveys", METADATA, _key(), *_texts("version", "map_id"),
    Column("is_own", Boolean, nullable=False), UniqueConstraint("version", "map_id"),
)  # fmt: skip
"""Surveys of a version. is_own: the survey was added to the store only for the version."""

PROMOTIONS = Table("promotions", METADATA, _key(), *_texts("version", "who"), *_stamps("at_ns"))
"""Versions that page and plant were switched to; the newest row counts, an empty version means none."""

CRANES = Table(
    "cranes", METADATA, _key(), Column("name", Text, nullable=False, unique=True), *_stamps("at_ns")
)

RIGS = Table("rigs", METADATA, _key(), _of("cranes"), *_texts("name"), *_stamps("at_ns"))
"""Rigs and the crane on which each is mounted; for each name the newest row counts."""

CALIBRATIONS = Table(
    "calibrations", METADATA, _key(), Column("digest", Text, nullable=False, unique=True), *_texts("rig"),
    *_stamps("at_ns"),
)  # fmt: skip
"""Calibrations, each with the name of its rig. digest: the `calibration_id` of surveys."""

VALIDITIES = Table(
    "validities", METADATA, _key(), _of("calibrations"), *_stamps("from_ns"),
    Column("until_ns", BigInteger), *_texts("approved_by"), Column("note", Text), *_stamps("at_ns"),
)  # fmt: skip
"""Periods for which a calibration was approved; for each rig the one that begins last counts, then the
newest.
"""

RECORDINGS = Table(
    "recordings", METADATA, _key(), Column("digest", Text, nullable=False, unique=True),
    *_texts("key", "rig"), *_stamps("at_ns"),
)  # fmt: skip
"""Recordings. digest: of their files' digests; key: path or URL where it was first found; rig: its name,
empty if unknown.
"""

RECORDING_STATES = Table(
    "recording_states", METADATA, _key(), _of("recordings"), Column("step", Integer, nullable=False),
    *_texts("state"), *_stamps("at_ns"), *_texts("who"), Column("note", Text),
    UniqueConstraint("recording_id", "step"),
)  # fmt: skip

SURVEY_RECORDINGS = Table(
    "survey_recordings", METADATA, _key(), _of("surveys"), _of("recordings"),
    UniqueConstraint("survey_id", "recording_id"),
)  # fmt: skip
