"""Create the table of the places where a crane's magnet came down, took a load or put it down."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """Create the table, with triggers like those of the first version."""
    op.create_table(
        "touches", sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("lift_id", sa.Integer, sa.ForeignKey("lifts.id")),
        sa.Column("kind", sa.Text, nullable=False),
        *(sa.Column(name, sa.Double, nullable=False) for name in ("x_m", "y_m", "z_m")),
        sa.Column("at_ns", sa.BigInteger, nullable=False), sa.Column("who", sa.Text, nullable=False),
    )  # fmt: skip
    op.create_index("ix_touches_lift_id", "touches", ["lift_id"])
    if op.get_bind().dialect.name != "sqlite":
        op.execute(
            "CREATE TRIGGER touches_adds_only BEFORE UPDATE OR DELETE OR TRUNCATE ON touches "
            "FOR EACH STATEMENT EXECUTE FUNCTION barsight_refuse_change()"
        )
        return
    for act in ("update", "delete"):
        op.execute(
            f"CREATE TRIGGER touches_no_{act} BEFORE {act.upper()} ON touches "
            "BEGIN SELECT RAISE(ABORT, 'the store only adds rows'); END"
        )
