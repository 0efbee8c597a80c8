"""Write the telegram's table as a reference page and as a source file for TIA Portal (SCL)."""

from __future__ import annotations

from barsight.plant.telegram import MAX_BEHIND, VERSION, fields_at, layout, table_of

_NAMES = {"out": "BarsightOut", "in": "BarsightIn"}
_ABOUT = {"out": "From Barsight to the PLC", "in": "From the PLC to Barsight"}
_SCL = {"u16": "UInt", "u32": "UDInt", "i32": "DInt", "i64": "LInt"}
_JUDGE = """
FUNCTION_BLOCK "BarsightJudge"
{ S7_Optimized_Access := 'TRUE' }
VERSION : 0.1
   VAR_INPUT
      silent : Time := T#300ms;   // Barsight's life counter may stand for so long
      maxBehind : DInt := {behind};   // Telegrams that the echo of the PLC's own life counter may be behind
   END_VAR
   VAR_OUTPUT
      isValid : Bool;   // Only then may a lift be claimed, or begun after `executing` was answered with 1
   END_VAR
   VAR
      life : UInt;
      hasLife : Bool;
      behind : DInt;
      sinceResumed : DInt;
      calledAt : Time;
      resumedLife : UInt;
      isResuming : Bool := TRUE;
      timer : TON_TIME;
   END_VAR
BEGIN
   #timer(IN := #hasLife AND ("BarsightOutDB".telegram."life" = #life), PT := #silent);
   #life := "BarsightOutDB".telegram."life";
   // After a pause of this program what waits is old: the echo of a life sent since then ends it.
   IF TIME_TCK() - #calledAt > #silent OR NOT #hasLife THEN
      #resumedLife := "BarsightInDB".telegram."life";
      #isResuming := TRUE;
   END_IF;
   #calledAt := TIME_TCK();
   #sinceResumed := UINT_TO_DINT("BarsightOutDB".telegram."life_echo") - UINT_TO_DINT(#resumedLife);
   IF #sinceResumed < 0 THEN
      #sinceResumed := #sinceResumed + 65536;
   END_IF;
   IF #sinceResumed >= 1 AND #sinceResumed < 32768 THEN
      #isResuming := FALSE;
   END_IF;
   #behind := UINT_TO_DINT("BarsightInDB".telegram."life")
      - UINT_TO_DINT("BarsightOutDB".telegram."life_echo");
   IF #behind < 0 THEN
      #behind := #behind + 65536;
   END_IF;
   #hasLife := TRUE;
   #isValid := NOT #timer.Q AND NOT #isResuming AND (#behind <= #maxBehind)
      AND ("BarsightOutDB".telegram."magic" = {magic})
      AND ("BarsightOutDB".telegram."version" = {version})
      AND (("BarsightOutDB".telegram."status" AND 1) = 1);
END_FUNCTION_BLOCK
"""


def telegram_page() -> str:
    """Write the reference page: the bytes of each side."""
    lines = [
        "# Telegram\n\nThe bytes of the cyclic telegram ([how to connect](../how-to/connect-a-plant.md)) and "
        f"of the S7 exchange, version {VERSION}. Big-endian unless `byte_order` says otherwise, no gaps. "
        "`barsight plant scl` writes them as a source for TIA Portal.\n"
    ]
    for side in ("out", "in"):
        lines.append(f"\n## {_ABOUT[side]}: {layout(side).size} bytes\n\n")
        lines.append("| byte | field | type | meaning |\n|---|---|---|---|\n")
        lines += [f"| {at} | `{name}` | {kind} | {text} |\n" for at, name, kind, text in fields_at(side)]
    return "".join(lines)


def scl_source() -> str:
    """Write a source file for TIA Portal: types and data blocks of both sides, and the life counter check.

    For S7-1500, whose 64-bit integers the time stamps need.
    """
    lines = ["// Made by `barsight plant scl` from the telegram's table. The number after // is the byte.\n"]
    for side in ("out", "in"):
        lines.append(f'\nTYPE "{_NAMES[side]}"\nVERSION : 0.1\n   STRUCT\n')
        lines += [
            f'      "{name}" : {_SCL[kind]};   // {at}: {text}\n' for at, name, kind, text in fields_at(side)
        ]
        lines.append("   END_STRUCT;\nEND_TYPE\n")
    for side in ("out", "in"):
        lines.append(
            f"\nDATA_BLOCK \"{_NAMES[side]}DB\"\n{{ S7_Optimized_Access := 'FALSE' }}\nVERSION : 0.1\n"
            f'   STRUCT\n      telegram : "{_NAMES[side]}";\n   END_STRUCT;\nBEGIN\nEND_DATA_BLOCK\n'
        )
    magic = {name: text for name, _, text in table_of("out")}["magic"]
    judge = (
        _JUDGE.replace("{magic}", f"16#{magic.removeprefix('0x')}")
        .replace("{version}", str(VERSION))
        .replace("{behind}", str(MAX_BEHIND))
    )
    return "".join([*lines, judge])
