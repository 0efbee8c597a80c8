"""Check the data blocks of the S7 PUT/GET link; both are only read."""

from __future__ import annotations

import time
from dataclasses import replace

from barsight.core.errors import Failed
from barsight.plant.link_settings import S7Settings
from barsight.plant.links.link_check import LinkCheck
from barsight.plant.links.telegram_check import told_fields
from barsight.plant.s7 import S7Link
from barsight.plant.telegram import layout, unpack

LOOKS, EVERY_S = 5, 0.15


def check_s7(settings: S7Settings) -> LinkCheck | Failed:
    """Poll both data blocks; return readable lines and whether both life counters advance."""
    lines: list[str] = []
    is_good = True
    written = replace(settings, read_db=settings.write_db, read_start=settings.write_start)
    for side, side_settings in (("in", settings), ("out", written)):
        looked = _look(side_settings, layout(side).size)
        if isinstance(looked, Failed):
            return looked
        content, took_s = looked
        lives = [unpack(side, each) for each in content]
        moved = {each["life"] for each in lives if not isinstance(each, Failed)}
        wrong = next((each.reason for each in lives if isinstance(each, Failed)), None)
        who = "the PLC's" if side == "in" else "Barsight's"
        lines += [f"data block {side_settings.read_db}, {who}:", *told_fields(side, content[-1], "big")]
        lines.append(f"read in {max(took_s) * 1e3:.1f} ms at most")
        if wrong is not None:
            lines.append(f"NO TELEGRAM: {wrong}")
        lines.append(f"{who} life counter: " + ("moves" if len(moved) > 1 else "STANDS STILL"))
        is_good = is_good and wrong is None and len(moved) > 1
    return LinkCheck("s7", tuple(lines), is_good)


def _look(settings: S7Settings, size: int) -> tuple[list[bytes], list[float]] | Failed:
    link = S7Link(settings, size)
    content, took_s = [], []
    try:
        for _ in range(LOOKS):
            looked = link.read()
            if isinstance(looked, Failed):
                return looked
            content.append(looked.inputs)
            took_s.append(looked.read_s)
            time.sleep(EVERY_S)
    finally:
        link.close()
    return content, took_s
