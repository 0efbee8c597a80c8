"""Name cranes in the store, so that they are told from persons."""

from __future__ import annotations

_PLC, _OPC_UA = "plc ", " by OPC UA"


def plc_name(at: str) -> str:
    """Name a PLC by its address."""
    return f"{_PLC}{at}"


def opcua_name(user: str) -> str:
    """Name a crane by its user of OPC UA."""
    return f"{user}{_OPC_UA}"


def is_crane(who: str) -> bool:
    """Tell a crane's name from a person's, whose confirmations last as long as their map."""
    return who.startswith(_PLC) or who.endswith(_OPC_UA)
