"""Write the yard as a stock list, and record decisions on differences from one."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import chain, count
from typing import Literal

from barsight.core.errors import InputError
from barsight.store.audit import Entry
from barsight.store.confirmation import newest_survey
from barsight.store.history import PresentBundle
from barsight.store.tables import STOCK_DECISIONS
from barsight.yard.inventory.stock_list import ListedBundle

Decision = Literal["accepted", "rejected"]
"""accepted: the yard is right, and the list must be changed; rejected: the list is right, and the yard must
be checked.
"""


def listed_bundles(present: Iterable[PresentBundle]) -> tuple[ListedBundle, ...]:
    """List the bundles of a yard, named by a stock list, otherwise by their label or the store's name.

    Unknown values are left out, including the length of a bundle with an open end.
    """
    names: set[str] = set()
    listed = []
    for shown in present:
        bundle = shown.sighting.bundle
        label = None if bundle.label is None else bundle.label.text
        identity = shown.sighting.identity
        more = (f"{identity} ({number})" for number in count(2))
        wanted = chain((shown.sighting.stock_name, label, identity), more)
        name = next(each for each in wanted if each and each not in names)
        names.add(name)
        x_m, y_m, _ = (float(value) for value in bundle.centre_m)
        listed.append(
            ListedBundle(
                name, x_m, y_m, bundle.top_z_m, math.degrees(bundle.yaw_rad),
                None if any(bundle.ends_open) else bundle.length_m, bundle.width_m, bundle.bar_diameter_m,
                bundle.bars,
            )
        )  # fmt: skip
    return tuple(listed)


def decide(opened: Entry, map_id: str, difference: str, decision: Decision, note: str) -> None:
    """Add a decision on the newest survey's difference. Raises InputError if there is a newer survey."""
    newest = newest_survey(opened.connection)
    if newest is None or newest.map_id != map_id:
        raise InputError(map_id, "is not the newest survey any more", "look at the differences again")
    opened.add(
        STOCK_DECISIONS, survey_id=newest.id, difference=difference, decision=decision, at_ns=opened.at_ns,
        who=opened.who, note=note or None,
    )  # fmt: skip
