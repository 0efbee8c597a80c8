"""Create the tables of the page: accounts, and decisions on the stock list's differences."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"

TABLES = ("accounts", "stock_decisions")


def upgrade() -> None:
    """Create both tables, with triggers like those of the first version."""
    op.create_table(
        "accounts", sa.Column("id", sa.Integer, primary_key=True),
        *(sa.Column(name, sa.Text, nullable=False) for name in ("name", "kind", "role", "secret")),
        sa.Column("at_ns", sa.BigInteger, nullable=False), sa.Column("who", sa.Text, nullable=False),
    )  # fmt: skip
    op.create_table(
        "stock_decisions", sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("survey_id", sa.Integer, sa.ForeignKey("surveys.id"), nullable=False),
        *(sa.Column(name, sa.Text, nullable=False) for name in ("difference", "decision")),
        sa.Column("at_ns", sa.BigInteger, nullable=False), sa.Column("who", sa.Text, nullable=False),
        sa.Column("note", sa.Text),
    )  # fmt: skip
    op.create_index("ix_stock_decisions_survey_id", "stock_decisions", ["survey_id"])
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
