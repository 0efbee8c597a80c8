"""Create the table of the places where a fleet's recordings were found."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Create the table, with triggers like those of the first version."""
    op.create_table(
        "fleet_places", sa.Column("id", sa.Integer, primary_key=True),
        *(sa.Column(name, sa.Text, nullable=False) for name in ("key", "manifest", "archive", "recording")),
        sa.Column("at_ns", sa.BigInteger, nullable=False),
    )  # fmt: skip
    op.create_index("ix_fleet_places_key", "fleet_places", ["key"])
    if op.get_bind().dialect.name != "sqlite":
        op.execute(
            "CREATE TRIGGER fleet_places_adds_only BEFORE UPDATE OR DELETE OR TRUNCATE ON fleet_places "
            "FOR EACH STATEMENT EXECUTE FUNCTION barsight_refuse_change()"
        )
        return
    for act in ("update", "delete"):
        op.execute(
            f"CREATE TRIGGER fleet_places_no_{act} BEFORE {act.upper()} ON fleet_places "
            "BEGIN SELECT RAISE(ABORT, 'the store only adds rows'); END"
        )
