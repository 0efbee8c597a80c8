"""Create the tables, and triggers that reject any change or removal of a row."""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

TABLES = (
    "surveys", "bundles", "sightings", "absences", "lifts", "lift_bundles", "lift_states", "vetoes",
    "alarms", "alarm_states", "audit",
)  # fmt: skip


def upgrade() -> None:
    """Create all tables and triggers."""
    _create_surveys()
    _create_lifts()
    _create_logs()
    for table, column in (
        ("bundles", "survey_id"), ("sightings", "survey_id"), ("sightings", "bundle_id"),
        ("absences", "survey_id"), ("absences", "bundle_id"), ("lifts", "survey_id"),
        ("lift_bundles", "lift_id"), ("lift_bundles", "bundle_id"), ("lift_states", "lift_id"),
        ("vetoes", "survey_id"), ("vetoes", "bundle_id"), ("alarm_states", "alarm_id"),
    ):  # fmt: skip
        op.create_index(f"ix_{table}_{column}", table, [column])
    _refuse_changes()


def _key() -> sa.Column[int]:
    return sa.Column("id", sa.Integer, primary_key=True)


def _of(table: str, *, is_optional: bool = False) -> sa.Column[int]:
    name = f"{table.removesuffix('s')}_id"
    return sa.Column(name, sa.Integer, sa.ForeignKey(f"{table}.id"), nullable=is_optional)


def _wanted(kind: type[sa.types.TypeEngine[Any]], *names: str) -> list[sa.Column[Any]]:
    return [sa.Column(name, kind(), nullable=False) for name in names]


def _create_surveys() -> None:
    op.create_table(
        "surveys", _key(), sa.Column("map_id", sa.Text, nullable=False, unique=True),
        *_wanted(sa.BigInteger, "captured_from_ns", "captured_to_ns", "added_ns"),
        *_wanted(sa.Text, "calibration_id"), sa.Column("yard_frame_id", sa.Text),
        *_wanted(sa.Boolean, "is_simulated"), *_wanted(sa.Text, "software_version", "folder", "files"),
        *_wanted(sa.LargeBinary, "heights"),
    )  # fmt: skip
    op.create_table("bundles", _key(), _of("surveys"))
    op.create_table(
        "sightings", _key(), _of("surveys"), _of("bundles"), *_wanted(sa.Integer, "number"),
        *_wanted(sa.Text, "change"), sa.Column("stock_name", sa.Text),
        *_wanted(sa.Double, "x_m", "y_m", "top_z_m", "yaw_deg", "length_m", "width_m"),
        *_wanted(sa.Text, "record"), sa.UniqueConstraint("survey_id", "number"),
        sa.UniqueConstraint("survey_id", "bundle_id"),
    )  # fmt: skip
    op.create_table(
        "absences", _key(), _of("surveys"), _of("bundles"), *_wanted(sa.Text, "kind", "reason"),
        sa.UniqueConstraint("survey_id", "bundle_id"),
    )  # fmt: skip


def _create_lifts() -> None:
    op.create_table(
        "lifts", _key(), _of("surveys"), *_wanted(sa.Integer, "rank"), *_wanted(sa.Text, "record")
    )
    op.create_table(
        "lift_bundles", _key(), _of("lifts"), _of("bundles"), sa.UniqueConstraint("lift_id", "bundle_id")
    )
    _create_states("lifts")
    op.create_table(
        "vetoes", _key(), _of("surveys"), _of("bundles", is_optional=True),
        *_wanted(sa.Text, "code", "reason"),
    )  # fmt: skip


def _create_states(owners: str) -> None:
    owner = owners.removesuffix("s")
    op.create_table(
        f"{owner}_states", _key(), _of(owners), *_wanted(sa.Integer, "step"), *_wanted(sa.Text, "state"),
        *_wanted(sa.BigInteger, "at_ns"), *_wanted(sa.Text, "who"), sa.Column("note", sa.Text),
        sa.UniqueConstraint(f"{owner}_id", "step"),
    )  # fmt: skip


def _create_logs() -> None:
    op.create_table("alarms", _key(), *_wanted(sa.Text, "code", "reason"))
    _create_states("alarms")
    op.create_table(
        "audit", _key(), *_wanted(sa.BigInteger, "at_ns"), *_wanted(sa.Text, "who", "what", "content"),
        sa.Column("previous", sa.Text, nullable=False, unique=True), *_wanted(sa.Text, "digest"),
    )  # fmt: skip


def _refuse_changes() -> None:
    if op.get_bind().dialect.name == "sqlite":
        for table in TABLES:
            for act in ("update", "delete"):
                op.execute(
                    f"CREATE TRIGGER {table}_no_{act} BEFORE {act.upper()} ON {table} "
                    "BEGIN SELECT RAISE(ABORT, 'the store only adds rows'); END"
                )
        return
    op.execute(
        "CREATE FUNCTION barsight_refuse_change() RETURNS trigger LANGUAGE plpgsql AS "
        "$$ BEGIN RAISE EXCEPTION 'the store only adds rows'; END $$"
    )
    for table in TABLES:
        op.execute(
            f"CREATE TRIGGER {table}_adds_only BEFORE UPDATE OR DELETE OR TRUNCATE ON {table} "
            "FOR EACH STATEMENT EXECUTE FUNCTION barsight_refuse_change()"
        )
