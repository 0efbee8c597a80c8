"""Record what was decided of a difference between a survey and its stock list."""

from __future__ import annotations

from typing import Literal

from barsight.core.errors import InputError
from barsight.store.audit import Entry
from barsight.store.confirmation import newest_survey
from barsight.store.tables import STOCK_DECISIONS

Decision = Literal["accepted", "rejected"]
"""accepted: the yard is right, the list is to be changed; rejected: the list is right, the yard is to be
looked at.
"""


def decide(opened: Entry, map_id: str, difference: str, decision: Decision, note: str) -> None:
    """Add a decision on the newest survey's difference. Raises InputError where a newer survey came."""
    newest = newest_survey(opened.connection)
    if newest is None or newest.map_id != map_id:
        raise InputError(map_id, "is not the newest survey any more", "look at the differences again")
    opened.add(
        STOCK_DECISIONS, survey_id=newest.id, difference=difference, decision=decision, at_ns=opened.at_ns,
        who=opened.who, note=note or None,
    )  # fmt: skip
