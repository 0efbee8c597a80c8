"""Tell what changed in the yard between two times."""

from __future__ import annotations

from typing import Any

from barsight.core.extras import extra
from barsight.store.history import identity_name, present_yard
from barsight.store.matching import has_moved

with extra("store"):
    from sqlalchemy import Connection


def yard_changes(connection: Connection, before_ns: int, after_ns: int) -> list[dict[str, Any]]:
    """Tell what changed between two times: `came`, `went`, `moved`; what lies as it lay is left out."""
    before = {one.sighting.bundle_id: one.sighting for one in present_yard(connection, before_ns)}
    after = {one.sighting.bundle_id: one.sighting for one in present_yard(connection, after_ns)}
    told = []
    for number in sorted({*before, *after}):
        old, new = before.get(number), after.get(number)
        kind = "went" if new is None else "came" if old is None else "moved"
        if old is not None and new is not None and not has_moved(old.bundle, new.bundle):
            continue
        told.append(
            {
                "identity": identity_name(number), "what": kind,
                "from_m": None if old is None else old.record["axis_centre_m"],
                "to_m": None if new is None else new.record["axis_centre_m"],
                "from_ends_m": None if old is None else old.record["ends_m"],
                "to_ends_m": None if new is None else new.record["ends_m"],
                "width_m": [one.record["width_m"] for one in (old, new) if one is not None][-1],
            }
        )  # fmt: skip
    return told
