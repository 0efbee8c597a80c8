"""Encode and decode the cyclic telegram by its table, telegram.toml."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from barsight.core.errors import Failed
from barsight.core.reading.bounded_reading import read_toml
from barsight.plant.state import MAX_ALARMS, PlantState

TABLE = Path(__file__).parent / "telegram.toml"
OUT_MAGIC, IN_MAGIC, VERSION = 0xB51A, 0xB51B, 1
NOT_SET = -(2**31)
MAX_BEHIND = 3
"""Maximum number of telegrams that the echo of the PLC's life counter may be behind before a PLC rejects
them as outdated.
"""
_CODES = {"u16": "H", "u32": "I", "i32": "i", "i64": "q"}


@cache
def table_of(side: str) -> tuple[tuple[str, str, str], ...]:
    """Read the fields of side `out` or `in`: name, type, meaning."""
    return tuple((name, kind, text) for name, kind, text in read_toml(TABLE)[side]["fields"])


def fields_at(side: str) -> list[tuple[int, str, str, str]]:
    """List a side's fields: offset, name, type, meaning."""
    at, found = 0, []
    for name, kind, meaning in table_of(side):
        found.append((at, name, kind, meaning))
        at += width_of(kind)
    return found


def width_of(kind: str) -> int:
    """Return the number of bytes of a field type."""
    return int(kind[1:]) // 8


@cache
def layout(side: str, byte_order: str = "big") -> struct.Struct:
    """Form the layout of a side in a byte order."""
    order = ">" if byte_order == "big" else "<"
    return struct.Struct(order + "".join(_CODES[kind] for _, kind, _ in table_of(side)))


def pack(side: str, values: Mapping[str, int], byte_order: str = "big") -> bytes:
    """Write a telegram; fields that aren't given are 0."""
    return layout(side, byte_order).pack(*(values.get(name, 0) for name, _, _ in table_of(side)))


def unpack(side: str, content: bytes, byte_order: str = "big") -> dict[str, int] | Failed:
    """Read a telegram; return Failed if its length, magic, version or a value is invalid."""
    form = layout(side, byte_order)
    if len(content) != form.size:
        return Failed("telegram-length", f"{len(content)} bytes came, {form.size} are a telegram")
    found = dict(zip((name for name, _, _ in table_of(side)), form.unpack(content), strict=True))
    magic = OUT_MAGIC if side == "out" else IN_MAGIC
    if found["magic"] == int.from_bytes(magic.to_bytes(2, "little")):
        return Failed("telegram-kind", f"its bytes are in the other order than {byte_order} (byte_order)")
    if (found["magic"], found["version"]) != (magic, VERSION):
        return Failed("telegram-kind", f"magic {found['magic']:#06x}, version {found['version']}")
    if side == "in" and (found["command"] > 4 or found["flags"] > 15):
        return Failed("telegram-value", f"command {found['command']}, flags {found['flags']:#x}")
    return found


def out_values(state: PlantState, answer: Mapping[str, int]) -> dict[str, int]:
    """Form the fields of the telegram to the PLC. An invalid state carries no lift."""
    lift = state.lift if state.is_valid else None
    status = int(state.is_valid) | (8 if state.mode == "simulated" else 0)
    values = {
        "magic": OUT_MAGIC, "version": VERSION, "life": state.life_counter & 0xFFFF, "status": status,
        "stamp_ns": state.stamp_ns, "approach": NOT_SET, "alarms": min(len(state.alarms), MAX_ALARMS),
        **answer,
    }  # fmt: skip
    if lift is None:
        return values
    values["status"] |= {"offered": 2, "claimed": 4, "executing": 4 | 32}[lift.handshake]
    values |= {
        "lift_id": lift.lift_id, "checksum": int(lift.sha256[:8], 16), "valid_until_ns": lift.valid_until_ns,
        "x": _fine(lift.x_m, 1e4), "y": _fine(lift.y_m, 1e4), "z": _fine(lift.hoist_height_m, 1e4),
        "yaw": _fine(lift.yaw_deg, 1e3),
        "approach": NOT_SET if lift.approach_height_m is None else _fine(lift.approach_height_m, 1e4),
        "tolerance_x": int(lift.tolerance_x_m * 1e4), "tolerance_y": int(lift.tolerance_y_m * 1e4),
        "tolerance_yaw": int(lift.tolerance_yaw_deg * 1e3), "magnet_class": lift.magnet_class or 0,
        "mass": _fine(lift.mass_kg, 10), "mass_sigma": _fine(lift.mass_sigma_kg, 10), "count": lift.count,
    }  # fmt: skip
    place = (lift.set_down_x_m, lift.set_down_y_m, lift.set_down_z_m, lift.set_down_yaw_deg)
    if None not in place:
        values["status"] |= 16
        for name, value, factor in zip(("x", "y", "z", "yaw"), place, (1e4, 1e4, 1e4, 1e3), strict=True):
            values[f"set_down_{name}"] = _fine(value or 0.0, factor)
    return values


def _fine(value: float, factor: float) -> int:
    return round(value * factor)
