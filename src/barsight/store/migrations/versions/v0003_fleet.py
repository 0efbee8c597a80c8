"""Create the tables of the fleet: versions, tasks, results, surveys of a version, promotions."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"

TABLES = ("fleet_versions", "fleet_tasks", "fleet_results", "fleet_surveys", "promotions")


def _texts(*names: str) -> list[sa.Column[str]]:
    return [sa.Column(name, sa.Text, nullable=False) for name in names]


def _stamps(*names: str) -> list[sa.Column[int]]:
    return [sa.Column(name, sa.BigInteger, nullable=False) for name in names]


def _key() -> sa.Column[int]:
    return sa.Column("id", sa.Integer, primary_key=True)


def _unique(name: str) -> sa.Column[str]:
    return sa.Column(name, sa.Text, nullable=False, unique=True)


def upgrade() -> None:
    """Create the tables, with triggers like those of the first version."""
    op.create_table(
        "fleet_versions", _key(), _unique("name"),
        *_texts("configuration", "calibration", "magnet", "software", "rig"), *_stamps("at_ns"),
    )  # fmt: skip
    op.create_table(
        "fleet_tasks", _key(), _unique("key"), *_texts("version", "archive", "recording", "passes"),
        *_stamps("bytes", "pairs", "at_ns"),
    )  # fmt: skip
    op.create_table(
        "fleet_results", _key(), _unique("key"),
        *(sa.Column(name, sa.Double, nullable=False) for name in ("measured_s", "whole_s")),
        *_stamps("peak_bytes", "result_bytes", "at_ns"),
    )  # fmt: skip
    op.create_table(
        "fleet_surveys", _key(), *_texts("version", "map_id"),
        sa.Column("is_own", sa.Boolean, nullable=False),
        sa.UniqueConstraint("version", "map_id"),
    )  # fmt: skip
    op.create_table("promotions", _key(), *_texts("version", "who"), *_stamps("at_ns"))
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
