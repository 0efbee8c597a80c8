"""Keep the accounts of the page: persons with passwords, programs with tokens, each with a role."""

from __future__ import annotations

import hashlib
import hmac
import secrets
from dataclasses import dataclass
from typing import Literal, get_args

from barsight.core.errors import ConfigError
from barsight.core.extras import extra
from barsight.core.passwords import expect_password, is_account_name, password_digest
from barsight.store.audit import Entry
from barsight.store.tables import ACCOUNTS

with extra("store"):
    from sqlalchemy import Connection, select

Role = Literal["viewer", "operator", "engineer", "service"]
ROLES: tuple[Role, ...] = get_args(Role)
NO_ROLE = "none"
"""Role of an account that was withdrawn."""
_NOBODY = f"{'0' * 32}${'0' * 128}"


@dataclass(frozen=True)
class Account:
    """A name that may use the page.

    kind: `person` or `token`. secret: a person's scrypt salt and digest of the password, or SHA-256 of a
    token.
    """

    name: str
    kind: str
    role: Role
    secret: str


def list_accounts(connection: Connection) -> dict[str, Account]:
    """List the active accounts by name."""
    newest: dict[str, Account] = {}
    for row in connection.execute(select(ACCOUNTS).order_by(ACCOUNTS.c.id)).all():
        newest[row.name] = Account(row.name, row.kind, row.role, row.secret)
    return {name: one for name, one in newest.items() if one.role in ROLES}


def add_person(opened: Entry, name: str, role: str, password: str) -> None:
    """Add a person, or change role and password of an existing one. Raises ConfigError."""
    expect_password(password)
    salt = secrets.token_bytes(16)
    _add(opened, name, "person", role, f"{salt.hex()}${password_digest(password, salt)}")


def add_token(opened: Entry, name: str, role: str) -> str:
    """Add a token for a program and return it; the store keeps only its digest. Raises ConfigError."""
    token = secrets.token_urlsafe(32)
    _add(opened, name, "token", role, token_digest(token))
    return token


def withdraw(opened: Entry, name: str) -> None:
    """Withdraw an account. Raises ConfigError if there is none, or if it is the last engineer."""
    accounts = list_accounts(opened.connection)
    if name not in accounts:
        raise ConfigError(f"there is no account {name!r}")
    _expect_engineer_beside(accounts, name)
    opened.add(
        ACCOUNTS, name=name, kind=accounts[name].kind, role=NO_ROLE, secret="", at_ns=opened.at_ns,
        who=opened.who,
    )  # fmt: skip


def is_password(account: Account | None, password: str) -> bool:
    """Check a person's password; an unknown name takes the same time."""
    secret = account.secret if account is not None and account.kind == "person" else _NOBODY
    salt, _, digest = secret.partition("$")
    return hmac.compare_digest(password_digest(password, bytes.fromhex(salt)), digest)


def token_digest(token: str) -> str:
    """Compute SHA-256 of a token: it has 256 random bits, so that no slow digest is needed."""
    return hashlib.sha256(token.encode()).hexdigest()


def _add(opened: Entry, name: str, kind: str, role: str, secret: str) -> None:
    if not is_account_name(name):
        raise ConfigError(f"{name!r} is no name: letters, digits and . _ @ - are, 60 at most")
    if role not in ROLES:
        raise ConfigError(f"there is no role {role!r}; known are {', '.join(ROLES)}")
    known = list_accounts(opened.connection)
    if name in known and known[name].kind != kind:
        raise ConfigError(f"{name} is a {known[name].kind} already; withdraw it first")
    if not known and (kind, role) != ("person", "engineer"):
        raise ConfigError("the first account is a person with the role engineer, who may add others")
    if role != "engineer":
        _expect_engineer_beside(known, name)
    opened.add(ACCOUNTS, name=name, kind=kind, role=role, secret=secret, at_ns=opened.at_ns, who=opened.who)


def _expect_engineer_beside(accounts: dict[str, Account], name: str) -> None:
    """Raise ConfigError if no other person would be left to add accounts."""
    engineers = [one.name for one in accounts.values() if one.kind == "person" and one.role == "engineer"]
    if engineers == [name]:
        raise ConfigError(f"{name} is the last engineer; add another one first")
