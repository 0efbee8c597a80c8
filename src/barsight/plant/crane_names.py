"""Name cranes in the store so that they can be told apart from persons."""

from __future__ import annotations

_PLC, _OPC_UA = "plc ", " by OPC UA"


def plc_name(at: str) -> str:
    """Name a PLC by its address."""
    return f"{_PLC}{at}"


def opcua_name(user: str) -> str:
    """Name a crane by its OPC UA user."""
    return f"{user}{_OPC_UA}"


def is_crane(who: str) -> bool:
    """Return True for a crane's name. A person's confirmations, unlike a crane's, last as long as the map."""
    return who.startswith(_PLC) or who.endswith(_OPC_UA)
