"""Determine which surveys count: of recordings that were measured anew, those of the promoted version."""

from __future__ import annotations

from functools import cache

from barsight.core.extras import extra
from barsight.store.tables import FLEET_SURVEYS, PROMOTIONS, SURVEYS

with extra("store"):
    from sqlalchemy import Connection, Select, and_, exists, literal, or_, select
    from sqlalchemy.sql.elements import ColumnElement


def promoted_version(connection: Connection) -> str:
    """Return the version that page and plant use; empty if none was promoted."""
    return str(connection.execute(_newest_promotion()).scalar() or "")


@cache
def counts(version: str | None = None) -> ColumnElement[bool]:
    """Build the condition on SURVEYS that selects those that count, or that would if `version` were promoted.

    A survey that was added only for a version counts while that version is promoted. Any other survey counts
    unless the promoted version has one of the same recording, identified by its first and last frame times.
    """
    promoted = _newest_promotion().scalar_subquery() if version is None else literal(version)
    own, chosen, other, twin = (
        FLEET_SURVEYS.alias("own"), FLEET_SURVEYS.alias("chosen"), FLEET_SURVEYS.alias("other"),
        SURVEYS.alias("twin"),
    )  # fmt: skip
    is_chosen = exists().where(chosen.c.map_id == SURVEYS.c.map_id, chosen.c.version == promoted)
    is_own = exists().where(own.c.map_id == SURVEYS.c.map_id, own.c.is_own.is_(True))
    has_twin = exists().where(
        other.c.version == promoted, twin.c.map_id == other.c.map_id,
        twin.c.captured_from_ns == SURVEYS.c.captured_from_ns,
        twin.c.captured_to_ns == SURVEYS.c.captured_to_ns,
    )  # fmt: skip
    return or_(is_chosen, and_(~is_own, ~has_twin))


def _newest_promotion() -> Select[tuple[str]]:
    return select(PROMOTIONS.c.version).order_by(PROMOTIONS.c.id.desc()).limit(1)
