"""Import the package asyncua, which the extra `opcua` installs; no other file imports it."""

from __future__ import annotations

from barsight.core.extras import extra

with extra("opcua"):
    from asyncua import Client, Node, Server, ua
    from asyncua.common.utils import ServiceError
    from asyncua.crypto.permission_rules import SimpleRoleRuleset, User, UserRole
    from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
    from asyncua.server.event_generator import EventGenerator
    from asyncua.server.internal_server import InternalServer
    from asyncua.server.internal_session import InternalSession

__all__ = [
    "Client", "EventGenerator", "InternalServer", "InternalSession", "Node",
    "SecurityPolicyBasic256Sha256", "Server", "ServiceError",
    "SimpleRoleRuleset", "User", "UserRole", "ua",
]  # fmt: skip
