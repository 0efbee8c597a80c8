"""Authenticate clients by certificate and password, and restrict each call to its user's role."""

from __future__ import annotations

import contextvars
import hmac
import json
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.errors import ConfigError, InputError
from barsight.core.extras import extra
from barsight.core.files import atomic_path
from barsight.core.passwords import expect_password, is_account_name, password_digest
from barsight.core.reading.bounded_reading import read_json
from barsight.plant.link_settings import OPCUA_ROLES, OpcUaSettings
from barsight.plant.opcua.security.binding import (
    InternalServer,
    InternalSession,
    ServiceError,
    SimpleRoleRuleset,
    User,
    UserRole,
    ua,
)
from barsight.plant.opcua.security.certificates import judge_certificate

with extra("opcua"):
    from cryptography import x509


@dataclass(frozen=True)
class OpcUaUser:
    """A user: role, and salt and scrypt digest of the password (hex)."""

    role: str
    salt: str
    digest: str


@dataclass
class RoleUser(User):  # type: ignore[misc]
    """An asyncua user with a Barsight role."""

    plant_role: str = "viewer"


_CALLER: contextvars.ContextVar[RoleUser] = contextvars.ContextVar("opcua_caller")


def caller() -> RoleUser:
    """Return the caller of the method that is running."""
    return _CALLER.get(RoleUser(UserRole.Anonymous, "nobody"))


def has_role(role: str) -> bool:
    """Return True if the caller of the running method has at least `role`."""
    return OPCUA_ROLES.index(caller().plant_role) >= OPCUA_ROLES.index(role)


def read_users(path: Path | None) -> dict[str, OpcUaUser]:
    """Read users.json. Raises InputError if it wasn't written by `add_user`."""
    if path is None or not path.exists():
        return {}
    try:
        content = read_json(path, "write it anew")
        users = {str(name): OpcUaUser(**fields) for name, fields in content.items()}
        for user in users.values():
            bytes.fromhex(user.salt), bytes.fromhex(user.digest)
            if user.role not in OPCUA_ROLES:
                raise ValueError(f"{user.role!r} is no role")
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(path, f"is not a list of users ({error})", "write it anew") from error
    return users


def add_user(path: Path, name: str, role: str, password: str) -> None:
    """Add a user to users.json, or change role and password of an existing one. Raises ConfigError."""
    expect_password(password)
    if role not in OPCUA_ROLES or not is_account_name(name):
        raise ConfigError(f"{name!r}: a name has letters and digits, and the role is one of {OPCUA_ROLES}")
    salt = secrets.token_bytes(16)
    user = OpcUaUser(role, salt.hex(), password_digest(password, salt))
    users = {**read_users(path), name: user}
    with atomic_path(path) as temporary:
        temporary.touch(0o600)
        temporary.write_text(json.dumps({one: vars(fields) for one, fields in users.items()}, indent=1))


class PasswordUsers:
    """Check user names and passwords for asyncua."""

    def __init__(self, users: Mapping[str, OpcUaUser], allow_anonymous: bool) -> None:
        self._users = users
        self._allow_anonymous = allow_anonymous

    def get_user(
        self, iserver: Any, username: str | None = None, password: str | None = None, certificate: Any = None
    ) -> RoleUser | None:
        """Return the user, or None if the login is refused."""
        if username is None:
            return RoleUser(UserRole.User, "anonymous") if self._allow_anonymous else None
        known = self._users.get(username)
        salt = bytes.fromhex(known.salt) if known else b"0" * 16
        digest = password_digest(password or "", salt)
        if known is None or not hmac.compare_digest(digest, known.digest):
            return None
        return RoleUser(UserRole.User, username, known.role)


class PlantSession(InternalSession):  # type: ignore[misc]
    """A client's session, bound to its channel's certificate; its methods know their caller.

    asyncua validates the certificate in CreateSession, but verifies the signature with that of the channel.
    Here both must be the same; otherwise a client could present someone else's certificate.
    """

    shown: bytes | None = None

    async def create_session(self, params: Any, sockname: Any = None) -> Any:
        """Keep the certificate that the client presents."""
        self.shown = params.ClientCertificate or None
        return await super().create_session(params, sockname)

    def activate_session(self, params: Any, peer_certificate: bytes | None) -> Any:
        """Refuse a channel without a certificate, or with one other than the validated certificate."""
        if not peer_certificate and not self.iserver.allow_unsecured:
            raise ServiceError(ua.StatusCodes.BadSecurityModeRejected)
        if peer_certificate and peer_certificate != self.shown:
            raise ServiceError(ua.StatusCodes.BadSecurityChecksFailed)
        return super().activate_session(params, peer_certificate)

    async def call(self, params: Any) -> Any:
        """Call methods as this session's user."""
        token = _CALLER.set(self.user if isinstance(self.user, RoleUser) else caller())
        try:
            return await super().call(params)
        finally:
            _CALLER.reset(token)


class BoundedServer(InternalServer):  # type: ignore[misc]
    """asyncua's internal server with limits on clients, subscriptions, queues and their lifetime."""

    def __init__(self, settings: OpcUaSettings, users: PasswordUsers) -> None:
        self.allow_unsecured = settings.allow_unsecured
        super().__init__(users)
        self.allow_remote_admin = False
        self.max_connections = settings.max_clients
        self.max_subscriptions = settings.max_subscriptions
        self.max_monitored_item_queue_size = settings.max_queue
        self.max_unacked_messages_per_subscription = settings.max_unacknowledged
        self.max_lifetime_count = settings.max_subscription_cycles
        self.max_keep_alive_count = settings.max_subscription_cycles // 3
        self.max_session_timeout_ms = 120_000
        self.max_pending_activation_seconds = 10.0
        self.max_pending_messages_per_connection = 100
        folder = settings.folder

        async def judge(certificate: x509.Certificate, application: Any) -> None:
            refused = judge_certificate(folder, certificate, application.ApplicationUri)
            if refused is not None:
                raise ServiceError(getattr(ua.StatusCodes, refused))

        self.certificate_validator = judge

    def create_session(self, name: str, user: Any = None, external: bool = False) -> PlantSession:
        """Create a client's session."""
        return PlantSession(
            self, self.aspace, self.subscription_service, name, user=user or RoleUser(UserRole.Anonymous),
            external=external,
        )  # fmt: skip


class PlantRules(SimpleRoleRuleset):  # type: ignore[misc]
    """Services that a client may use: all except those that change the address space."""
