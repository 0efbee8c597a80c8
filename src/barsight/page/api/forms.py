"""Define the forms of requests to the page's API."""

from __future__ import annotations

from barsight.core.extras import extra
from barsight.store.accounts import Role
from barsight.store.stock import Decision

with extra("page"):
    from pydantic import BaseModel, Field


class LogInForm(BaseModel):
    """Name and password."""

    name: str = Field(max_length=60)
    password: str = Field(max_length=1000)


class ConfirmForm(BaseModel):
    """The map that the operator saw, and the operator's name if the store has no accounts."""

    map_id: str = Field(max_length=64)
    name: str = Field("", max_length=60)


class NoteForm(BaseModel):
    """A sentence for the audit log."""

    note: str = Field("", max_length=1000)


class EndForm(NoteForm):
    """End of a lift that was not taken: `expired` (declined, or withdrawn) or `failed`."""

    state: str


class AlarmForm(BaseModel):
    """An alarm that a program raises."""

    code: str = Field(pattern=r"^[a-z][a-z0-9-]{0,39}$")
    reason: str = Field(min_length=1, max_length=1000)


class VetoForm(BaseModel):
    """A veto against the newest map, by a code from the reference of codes."""

    code: str
    reason: str = Field(min_length=1, max_length=1000)


class DecisionForm(NoteForm):
    """Decision on one difference of the stock list, by its key."""

    map_id: str
    key: str = Field(max_length=200)
    decision: Decision


class ApprovalForm(NoteForm):
    """A calibration and the period of its approval, from now on."""

    digest: str = Field(max_length=64)
    until_ns: int | None = None


class PickForm(BaseModel):
    """A target's pick in a survey's map, m. is_exact: use the picked position, not a disc near it."""

    name: str = Field(max_length=200)
    x_m: float
    y_m: float
    is_exact: bool = False


class TargetsForm(BaseModel):
    """A list of surveyed places (CSV), the sigma of a coordinate for lists without one, and the picks."""

    listed: str = Field(min_length=1, max_length=200_000)
    sigma_m: float
    picks: list[PickForm] = Field(max_length=1000)


class AccountForm(BaseModel):
    """An account to add or change. password: of a person; for a program a token is generated."""

    name: str
    kind: str = Field(pattern="^(person|token)$")
    role: Role
    password: str = Field("", max_length=1000)
