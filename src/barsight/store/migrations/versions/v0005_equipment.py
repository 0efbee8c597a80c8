"""Create the tables of cranes, rigs, calibrations with their validity, and recordings."""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"

TABLES = (
    "cranes", "rigs", "calibrations", "validities", "recordings", "recording_states", "survey_recordings",
)  # fmt: skip


def _wanted(kind: type[sa.types.TypeEngine[Any]], names: str) -> list[sa.Column[Any]]:
    """Make required columns. names: separated by spaces."""
    return [sa.Column(name, kind, nullable=False) for name in names.split()]


def _key() -> sa.Column[int]:
    return sa.Column("id", sa.Integer, primary_key=True)


def _unique(name: str) -> sa.Column[str]:
    return sa.Column(name, sa.Text, nullable=False, unique=True)


def _of(table: str) -> sa.Column[int]:
    name = f"{table.removesuffix('s')}_id"
    return sa.Column(name, sa.Integer, sa.ForeignKey(f"{table}.id"), nullable=False)


def upgrade() -> None:
    """Create the tables, with triggers like those of the first version."""
    op.create_table("cranes", _key(), _unique("name"), *_wanted(sa.BigInteger, "at_ns"))
    op.create_table(
        "rigs", _key(), _of("cranes"), *_wanted(sa.Text, "name"), *_wanted(sa.BigInteger, "at_ns")
    )
    op.create_table(
        "calibrations", _key(), _unique("digest"), *_wanted(sa.Text, "rig"), *_wanted(sa.BigInteger, "at_ns")
    )
    op.create_table(
        "validities", _key(), _of("calibrations"), *_wanted(sa.BigInteger, "from_ns"),
        sa.Column("until_ns", sa.BigInteger), *_wanted(sa.Text, "approved_by"), sa.Column("note", sa.Text),
        *_wanted(sa.BigInteger, "at_ns"),
    )  # fmt: skip
    op.create_table(
        "recordings",
        _key(),
        _unique("digest"),
        *_wanted(sa.Text, "key rig"),
        *_wanted(sa.BigInteger, "at_ns"),
    )
    op.create_table(
        "recording_states", _key(), _of("recordings"), sa.Column("step", sa.Integer, nullable=False),
        *_wanted(sa.Text, "state who"), *_wanted(sa.BigInteger, "at_ns"), sa.Column("note", sa.Text),
        sa.UniqueConstraint("recording_id", "step"),
    )  # fmt: skip
    op.create_table(
        "survey_recordings", _key(), _of("surveys"), _of("recordings"),
        sa.UniqueConstraint("survey_id", "recording_id"),
    )  # fmt: skip
    for table, column in (
        ("rigs", "crane_id"), ("validities", "calibration_id"), ("recording_states", "recording_id"),
        ("survey_recordings", "survey_id"), ("survey_recordings", "recording_id"),
    ):  # fmt: skip
        op.create_index(f"ix_{table}_{column}", table, [column])
    _refuse_changes()


def _refuse_changes() -> None:
    for table in TABLES:
        if op.get_bind().dialect.name != "sqlite":
            op.execute(
                f"CREATE TRIGGER {table}_adds_only BEFORE UPDATE OR DELETE OR TRUNCATE ON {table} "
                "FOR EACH STATEMENT EXECUTE FUNCTION barsight_refuse_change()"
            )
            continue
        for act in ("update", "delete"):
            op.execute(
                f"CREATE TRIGGER {table}_no_{act} BEFORE {act.upper()} ON {table} "
                "BEGIN SELECT RAISE(ABORT, 'the store only adds rows'); END"
            )
