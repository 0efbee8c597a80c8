"""Define the forms of requests to the page's API, and the range of their numbers."""

from __future__ import annotations

from typing import Annotated, Any

from barsight.core.extras import extra
from barsight.store.accounts import Role
from barsight.store.stock import Decision
from barsight.store.tables import MAX_ID

with extra("page"):
    from pydantic import BaseModel, Field, field_validator

Number = Annotated[int, Field(ge=0, le=MAX_ID)]
"""A row's id."""
Stamp = Annotated[int, Field(ge=0, lt=2**63)]
"""A time in ns, as a store can hold it."""


class Form(BaseModel):
    """A request's content. Its texts are ones that each database takes."""

    @field_validator("*")
    @classmethod
    def expect_text(cls, value: Any) -> Any:
        """Refuse texts with half a character (a lone surrogate) or NUL."""
        if isinstance(value, str) and ("\0" in value or value.encode(errors="ignore").decode() != value):
            raise ValueError("holds characters that are no text")
        return value


class LogInForm(Form):
    """Name and password."""

    name: str = Field(max_length=60)
    password: str = Field(max_length=1000)


class ConfirmForm(Form):
    """The map that the operator saw, and the operator's name if the store has no accounts."""

    map_id: str = Field(max_length=64)
    name: str = Field("", max_length=60)


class NoteForm(Form):
    """A sentence for the audit log."""

    note: str = Field("", max_length=1000)


class EndForm(NoteForm):
    """End of a lift that was not taken: `expired` (declined, or withdrawn) or `failed`."""

    state: str = Field(max_length=64)


class AlarmForm(Form):
    """An alarm that a program raises."""

    code: str = Field(pattern=r"^[a-z][a-z0-9-]{0,39}$")
    reason: str = Field(min_length=1, max_length=1000)


class VetoForm(Form):
    """A veto against the newest map, by a code from the reference of codes."""

    code: str = Field(max_length=64)
    reason: str = Field(min_length=1, max_length=1000)


class DecisionForm(NoteForm):
    """Decision on one difference of the stock list, by its key."""

    map_id: str = Field(max_length=64)
    key: str = Field(max_length=200)
    decision: Decision


class ApprovalForm(NoteForm):
    """A calibration and the period of its approval, from now on."""

    digest: str = Field(max_length=64)
    until_ns: int | None = None


class PickForm(Form):
    """A target's pick in a survey's map, m. is_exact: use the picked position, not a disc near it."""

    name: str = Field(max_length=200)
    x_m: float
    y_m: float
    is_exact: bool = False


class TargetsForm(Form):
    """A list of surveyed places (CSV), the sigma of a coordinate for lists without one, and the picks."""

    listed: str = Field(min_length=1, max_length=200_000)
    sigma_m: float
    picks: list[PickForm] = Field(max_length=1000)


class AccountForm(Form):
    """An account to add or change. password: of a person; for a program a token is generated."""

    name: str = Field(max_length=60)
    kind: str = Field(pattern="^(person|token)$")
    role: Role
    password: str = Field("", max_length=1000)
