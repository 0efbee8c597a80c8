"""Bind the package asyncua, which the extra `opcua` installs: the one file that imports it."""

from __future__ import annotations

from barsight.core.extras import extra

with extra("opcua"):
    from asyncua import Node, Server, ua
    from asyncua.common.utils import ServiceError
    from asyncua.crypto.permission_rules import SimpleRoleRuleset, User, UserRole
    from asyncua.server.event_generator import EventGenerator
    from asyncua.server.internal_server import InternalServer
    from asyncua.server.internal_session import InternalSession

__all__ = [
    "EventGenerator", "InternalServer", "InternalSession", "Node", "Server", "ServiceError",
    "SimpleRoleRuleset", "User", "UserRole", "ua",
]  # fmt: skip
