"""The telegram's page and its source text for TIA Portal, from the table of fields."""

from __future__ import annotations

from barsight.plant.telegram import IN_MAGIC, OUT_MAGIC, VERSION, table_of

_HEADS = {"out": "Barsight to the PLC", "in": "The PLC to Barsight"}
_TYPES = {"out": "BarsightOut", "in": "BarsightIn"}
_KINDS = {
    "u16": ("UInt", "WORD"),
    "u32": ("UDInt", "DWORD"),
    "i32": ("DInt", "DWORD"),
    "i64": ("LInt", "LWORD"),
}
_BITS = ("magic", "status", "flags")
"""Fields that the PLC takes as bits: Word, not UInt."""


def telegram_page() -> str:
    """Both sides' fields with offset and type."""
    lines = [
        "# Telegram\n\n",
        "Signed and unsigned integers without gaps, big-endian (`telegram.byte_order` changes it). "
        "[How to connect a plant](../how-to/connect-a-plant.md) says what each side has to do.\n\n",
        "For TIA Portal (S7-1500) there are source texts: [telegram.udt](telegram.udt) has both sides as "
        "data types, [telegram.scl](telegram.scl) the function blocks `BarsightUnpack` and `BarsightPack` "
        "for the bytes of TRCV and TSEND. Add them as external source files, the data types first. They were "
        "tested outside TIA Portal only. `BarsightUnpack.mayAct` is false where the state isn't valid or "
        "`life` stands for 300 ms: call it in every cycle.\n",
    ]
    for side, head in _HEADS.items():
        rows = "".join(f"| {at} | `{name}` | {kind} | {told} |\n" for at, name, kind, told in _placed(side))
        size = _size(side)
        lines.append(
            f"\n## {head}: {size} bytes\n\n| offset | field | type | meaning |\n|---|---|---|---|\n{rows}"
        )
    return "".join(lines)


def udt_text() -> str:
    """Both sides as TIA Portal's data types."""
    return "".join(_udt(side) for side in _HEADS)


def _udt(side: str) -> str:
    fields = "".join(
        f"      {name} : {_word(name, kind)[0]};   // {told}\n" for _, name, kind, told in _placed(side)
    )
    return f'TYPE "{_TYPES[side]}"\nVERSION : 0.1\n   STRUCT\n{fields}   END_STRUCT;\n\nEND_TYPE\n\n'


def scl_text() -> str:
    """Function blocks that take the bytes apart and put them together, big-endian."""
    unpacked = "".join(
        f"   #telegram.{name} := {_joined(at, name, kind)};\n" for at, name, kind, _ in _placed("out")
    )
    packed = "".join(_parted(at, name, kind) for at, name, kind, _ in _placed("in"))
    return f"""FUNCTION_BLOCK "BarsightUnpack"
{{ S7_Optimized_Access := 'TRUE' }}
VERSION : 0.1
   VAR_INPUT
      bytes : Array[0..{_size("out") - 1}] of Byte;   // as TRCV received them
   END_VAR
   VAR_OUTPUT
      telegram : "BarsightOut";
      isGood : Bool;   // magic and version fit
      mayAct : Bool;   // valid, and Barsight lives
   END_VAR
   VAR
      lastLife : UInt;
      watch {{InstructionName := 'TON_TIME'; LibVersion := '1.0'}} : TON_TIME;
   END_VAR

BEGIN
{unpacked}   #isGood := #telegram.magic = 16#{OUT_MAGIC:X} AND #telegram.version = {VERSION};
   #watch(IN := #telegram.life = #lastLife,
          PT := T#300ms);
   #lastLife := #telegram.life;
   #mayAct := #isGood AND NOT #watch.Q AND #telegram.status.%X0;
END_FUNCTION_BLOCK

FUNCTION_BLOCK "BarsightPack"
{{ S7_Optimized_Access := 'TRUE' }}
VERSION : 0.1
   VAR_OUTPUT
      bytes : Array[0..{_size("in") - 1}] of Byte;   // for TSEND
   END_VAR
   VAR_IN_OUT
      telegram : "BarsightIn";   // magic, version and life are set here
   END_VAR

BEGIN
   #telegram.magic := 16#{IN_MAGIC:X};
   #telegram.version := {VERSION};
   IF #telegram.life < 65535 THEN
      #telegram.life := #telegram.life + 1;
   ELSE
      #telegram.life := 0;
   END_IF;
{packed}END_FUNCTION_BLOCK
"""


def _placed(side: str) -> list[tuple[int, str, str, str]]:
    """Fields with their offsets."""
    at, found = 0, []
    for name, kind, told in table_of(side):
        found.append((at, name, kind, told))
        at += _width(kind)
    return found


def _size(side: str) -> int:
    return sum(_width(kind) for _, kind, _ in table_of(side))


def _width(kind: str) -> int:
    return int(kind[1:]) // 8


def _word(name: str, kind: str) -> tuple[str, str]:
    """The PLC's type of a field, and the bit string of its width."""
    own, bits = _KINDS[kind]
    return ("Word" if name in _BITS else own), bits


def _joined(at: int, name: str, kind: str) -> str:
    own, bits = _word(name, kind)
    last = _width(kind) - 1
    parts = [f"SHL(IN := BYTE_TO_{bits}(#bytes[{at + k}]), N := {8 * (last - k)})" for k in range(last)] + [
        f"BYTE_TO_{bits}(#bytes[{at + last}])"
    ]
    whole = " OR ".join(parts)
    return whole if own == "Word" else f"{bits}_TO_{own.upper()}({whole})"


def _parted(at: int, name: str, kind: str) -> str:
    own, bits = _word(name, kind)
    value = f"#telegram.{name}" if own == "Word" else f"{own.upper()}_TO_{bits}(#telegram.{name})"
    last = _width(kind) - 1
    lines = [
        f"   #bytes[{at + k}] := {bits}_TO_BYTE(SHR(IN := {value}, N := {8 * (last - k)}));\n"
        for k in range(last)
    ]
    return "".join([*lines, f"   #bytes[{at + last}] := {bits}_TO_BYTE({value});\n"])
