"""The telegram: bytes against offsets written by hand, and bytes that are no telegram."""

import math
import random
import re
import struct

import numpy as np
import pytest

from barsight.core.errors import Failed
from barsight.plant.state import YAW_SENSE, OfferedLift, PlantState
from barsight.plant.telegram import fields_at, layout, out_values, pack, unpack
from barsight.plant.telegram_texts import scl_source
from barsight.yard.magnet.footprint import Placement
from lift_yards import judged, laid, record

LIFT = OfferedLift(
    7, 1.5, -0.25, 0.7, 90.5, "ccw", 0.7, None, 2, 0.015, 0.03, 0.2, 1737.4, 522.2, 1, 3.0, 0.0, 0.1, 90.5,
    1_700_000_000_000_000_000, "map", "offered", "0a0b0c0d" + 56 * "0",
)  # fmt: skip
VALID = PlantState("surveyed", True, (), 65537, 5, "done", None, LIFT)


def test_bytes_lie_where_the_table_says() -> None:
    content = pack("out", out_values(VALID, {"answer_number": 3, "answer": 1, "token": 9}))
    assert struct.unpack_from(">HHHHq", content) == (0xB51A, 1, 1, 1 | 2 | 16, 5)
    assert struct.unpack_from(">IIq", content, 16) == (7, 0x0A0B0C0D, 1_700_000_000_000_000_000)
    assert struct.unpack_from(">iiiii", content, 32) == (15000, -2500, 7000, 90500, -(2**31))
    assert struct.unpack_from(">HHHHII", content, 52) == (150, 300, 200, 2, 17374, 5222)
    assert struct.unpack_from(">HHHHIiiii", content, 68) == (1, 3, 1, 0, 9, 30000, 0, 1000, 90500)
    assert len(content) == 98


def test_a_state_that_is_not_valid_carries_no_lift() -> None:
    state = PlantState("surveyed", False, ("x",), 1, 5, "done", None, LIFT)
    assert unpack("out", pack("out", out_values(state, {})))["lift_id"] == 0  # type: ignore[index]


def test_what_is_no_telegram_is_refused() -> None:
    draw = random.Random(22)
    for _ in range(2000):
        content = draw.randbytes(draw.randrange(2 * layout("in").size))
        assert isinstance(unpack("in", content), Failed)


def test_the_plc_source_lays_the_bytes_out_as_the_telegram() -> None:
    """SCL's own widths decide: a value written at each field's place is read back by the telegram's code."""
    widths = {"UInt": "H", "UDInt": "I", "DInt": "i", "LInt": "q"}
    for side in ("out", "in"):
        name = {"out": "BarsightOut", "in": "BarsightIn"}[side]
        block = scl_source().split(f'TYPE "{name}"')[1].split("END_STRUCT")[0]
        fields = re.findall(r'"(\w+)" : (\w+);   // (\d+):', block)
        values = {field: number for number, (field, _, _) in enumerate(fields, 1)}
        content = bytearray(layout(side).size)
        for field, kind, at in fields:
            struct.pack_into(f">{widths[kind]}", content, int(at), values[field])
        assert bytes(content) == pack(side, values)
        assert sum(struct.calcsize(widths[kind]) for _, kind, _ in fields) == len(content)


def plain_text(source: str) -> str:
    """Structured text by IEC 61131-3, without what only Siemens has: quotes, `#`, VERSION, data blocks."""
    rules = (
        (r"\{[^}]*\}", ""), (r"(?m)^VERSION.*$", ""), (r"(?s)DATA_BLOCK.*?END_DATA_BLOCK", ""), ('"', ""),
        (r"(?<!\w)#", ""), (r"(?m)^TYPE (\w+)$", r"TYPE \1 :"), (r"(?m)^BEGIN$", ""),
    )  # fmt: skip
    for pattern, plain in rules:
        source = re.sub(pattern, plain, source)
    return source


def test_the_plc_source_is_structured_text() -> None:
    """A grammar of another's reads it; no compiler of Siemens' SCL is free."""
    tree_sitter = pytest.importorskip("tree_sitter")
    grammar = pytest.importorskip("tree_sitter_iec61131_3_st")
    parser = tree_sitter.Parser(tree_sitter.Language(grammar.language()))

    def is_read(text: str) -> bool:
        return not parser.parse(text.encode()).root_node.has_error

    text = plain_text(scl_source())
    assert text.count("END_TYPE") == 2 and "BarsightJudge" in text and is_read(text)
    for part in (" THEN", "END_IF;", "END_VAR", ":=", "silent);"):
        assert not is_read(text.replace(part, "", 1)), part


def test_the_yaw_that_a_plc_is_told_turns_the_beam_onto_the_bundle() -> None:
    """The table says: from +Y, counter-clockwise. From another axis the beam would lie across."""
    stock = [laid(0.3, yaw_deg=20.0)]
    lift = judged(stock, place=Placement(0.3, 0.0, math.radians(20.0)))
    told = {name: text for _, name, _, text in fields_at("out")}["yaw"]
    assert "from +Y" in told and "counter-clockwise" in told and "from +Y" in YAW_SENSE
    yaw = math.radians(lift.place.yaw_deg)
    beam = np.array([-math.sin(yaw), math.cos(yaw)])
    ends = record(stock[0]).ends_m[:, :2]
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    assert abs(beam @ along) > 0.9999
