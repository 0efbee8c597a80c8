"""Damage files by their structure: text by its numbers, words and lines, JSON by its tree and seal, pictures
by their header, archives and maps by their bytes, and any of them by what lies in its place.

What leads out of the scratch folder leads to SECRET, never to a file of the machine, and nothing is written
through a link: whoever runs this may be root.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

SECRET = Path(tempfile.gettempdir()) / "barsight_fuzz_secret.txt"
"""Stands for what is elsewhere on the machine: never changed, never in an output."""
MARK = b"kept from everyone: 31 41 59 26 53 58 97 93\n"
MAX_DAMAGED_BYTES = 16 << 20
MAX_REPEATED_SIGNS = 2_000_000
NUMBERS = (
    "9" * 400, "-" + "9" * 400, "9" * 6000, "1e999990", "1e-999990", "1e308", "-1e308", "1e300", "1e10",
    "nan", "-inf", "inf", "-0", "0", "-1", "1", "2", "1e5", "100000", "65536", "2147483648",
    "9223372036854775807", "9223372036854775808", "18446744073709551616", "1e19", "0.1e", "0x10", "0b1",
    "1_000", "2001-99-99", "2001-01-01", "12:30:45", "", " ", "true", "null", "~", "[]", "{}", "[1]", "1,2",
    "\u0661\u0662", "1e-5", "5e-324", "--5", "+", ".", "1e", "0.5", "1e4", "1e6",
)  # fmt: skip
TEXTS = (
    "\x1b]0;owned\x07\x1b[31m", "\x00", "\x7f", "\ud800", "\u202e", str(SECRET), "../" * 8 + str(SECRET)[1:],
    "/dev/zero", "/dev/full", ".", "..", "", "a" * 70_000, "%s%n", "[bold]x[/bold]", "[/]", "{{7*7}}",
    "<script>alert(1)</script>", "\r", "\u2028", "*a", "&a [1]", "!!python/object/apply:os.system [x]",
    "!!timestamp 2001-99-99", "!!int x", "!!binary ???", "? [1]\n: 2", "<<: 1", "~", "\ufeff",
)  # fmt: skip
_NUMBER = re.compile(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")
UNREADABLE = (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError)
"""What an earlier turn may have made of a file."""
PNG = b"\x89PNG\r\n\x1a\n"


def mutate(path: Path, draw: random.Random) -> str:
    """Damage the file in one way that fits its kind; return how it was done. Links and what an earlier turn
    made large stay as they are.
    """
    if path.is_symlink() or not path.is_file() or path.stat().st_size > MAX_DAMAGED_BYTES:
        return ""
    if draw.random() < 0.08:
        return _replace(path, draw)
    kind = path.suffix.lower()
    if kind == ".json" and draw.random() < 0.7:
        return _json(path, draw)
    if kind in (".csv", ".txt", ".tum", ".yaml", ".yml", ".xml", ".toml", ".json"):
        return _text(path, draw)
    if kind == ".png" and draw.random() < 0.6:
        return _png(path, draw)
    if kind in (".ply", ".pgm") and draw.random() < 0.6:
        return _header(path, draw)
    return _bytes(path, draw)


def _replace(path: Path, draw: random.Random) -> str:
    """Put something else in the file's place."""

    def link(to: str) -> Callable[[], None]:
        return lambda: path.symlink_to(to)

    others = [
        other for other in sorted(path.parent.iterdir())
        if other.is_file() and not other.is_symlink() and other != path
    ]  # fmt: skip
    kinds: dict[str, Callable[[], Any]] = {
        "gone": lambda: None,
        "empty": lambda: path.write_bytes(b""),
        "a folder": path.mkdir,
        "a FIFO": lambda: os.mkfifo(path),
        "a link to elsewhere": link(str(SECRET)),
        "a link to /dev/zero": link("/dev/zero"),
        "a link to itself": link(path.name),
        "another file": lambda: shutil.copyfile(draw.choice(others), path) if others else None,
        "random bytes": lambda: path.write_bytes(draw.randbytes(draw.randrange(1, 5000))),
        "blanks": lambda: path.write_bytes(b" " * 300_000),
        "sparse": lambda: _sparse(path),
    }
    name = draw.choice(sorted(kinds))
    path.unlink()
    kinds[name]()
    return f"{path.name} is {name}"


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 33)


def _text(path: Path, draw: random.Random) -> str:
    text = path.read_text(encoding="utf-8", errors="replace")
    for _ in range(draw.choice((1, 1, 1, 2, 5))):
        text, how = draw.choice(_TEXT_WAYS)(text, draw)
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    return f"{path.name}: {how}"


def _number(text: str, draw: random.Random) -> tuple[str, str]:
    found = list(_NUMBER.finditer(text))
    if not found:
        return text, "no number"
    hit, value = draw.choice(found), draw.choice(NUMBERS)
    return text[: hit.start()] + value + text[hit.end() :], f"a number is {value[:20]!r}"


def _insert(text: str, draw: random.Random) -> tuple[str, str]:
    at, value = draw.randrange(len(text) + 1), draw.choice(TEXTS)
    return text[:at] + value + text[at:], f"{value[:20]!r} at {at}"


def _word(text: str, draw: random.Random) -> tuple[str, str]:
    words = list(re.finditer(r"[^\s,:\[\]{}\"=]+", text))
    if not words:
        return text, "no word"
    hit, value = draw.choice(words), draw.choice((*TEXTS, draw.choice(words)[0]))
    return text[: hit.start()] + value + text[hit.end() :], f"{hit[0][:20]!r} is {value[:20]!r}"


def _lines(text: str, draw: random.Random) -> tuple[str, str]:
    lines = text.split("\n")
    k = draw.randrange(len(lines))
    how = draw.choice(("dropped", "doubled", "swapped", "many", "cut", "header only"))
    if how == "dropped":
        del lines[k]
    elif how == "doubled":
        lines.insert(k, lines[k])
    elif how == "swapped":
        j = draw.randrange(len(lines))
        lines[j], lines[k] = lines[k], lines[j]
    elif how == "many":
        lines[k:k] = [lines[k]] * min(20_000, MAX_REPEATED_SIGNS // (len(lines[k]) + 1))
    elif how == "cut":
        lines = lines[:k]
    else:
        lines = lines[:1]
    return "\n".join(lines), f"line {k} {how}"


def _nested(text: str, draw: random.Random) -> tuple[str, str]:
    at, count, kind = draw.randrange(len(text) + 1), draw.choice((100, 3000, 100_000)), draw.choice("[{(-<")
    return text[:at] + kind * count + text[at:], f"{count} x {kind}"


def _aliases(text: str, draw: random.Random) -> tuple[str, str]:
    depth = draw.choice((9, 30))
    bomb = ["a0: &a0 [1, 1]"]
    merged = draw.random() < 0.5
    for k in range(1, depth):
        inner = ", ".join([f"*a{k - 1}"] * 9)
        bomb.append(f"a{k}: &a{k} {{<<: [{inner}]}}" if merged else f"a{k}: &a{k} [{inner}]")
    if merged:
        bomb[0] = "a0: &a0 {x: 1}"
    last = f"*a{depth - 1}"
    hit = draw.choice(list(_NUMBER.finditer(text)) or [re.match("", text)])
    assert hit is not None
    return "\n".join(bomb) + "\n" + text[: hit.start()] + last + text[
        hit.end() :
    ], f"{depth} layers of aliases"


_TEXT_WAYS = (_number, _number, _number, _number, _insert, _word, _word, _lines, _lines, _nested, _aliases)


def _json(path: Path, draw: random.Random) -> str:
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except UNREADABLE:
        return _bytes(path, draw)
    how = ""
    for _ in range(draw.choice((1, 1, 2, 4))):
        how = _change_node(tree, draw)
    if isinstance(tree, dict) and draw.random() < 0.8:
        _seal(tree, path)
    path.write_text(json.dumps(tree))
    return f"{path.name}: {how}"


def _change_node(tree: Any, draw: random.Random) -> str:
    places: list[tuple[Any, Any, str]] = []
    waiting = [(tree, "")]
    while waiting:
        node, where = waiting.pop()
        keys = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, item in keys:
            places.append((node, key, f"{where}.{key}"))
            waiting.append((item, f"{where}.{key}"))
    if not places:
        return "nothing"
    # A long list's items must not take all the turns.
    short = [place for place in places if place[2].count(".") <= draw.choice((1, 2, 3, 9))]
    node, key, where = draw.choice(short or places)
    values: list[Any] = [
        None, True, False, -1, 0, 1, 10**9, 10**25, 10**400, 1e308, float("nan"), float("-inf"), "", "x",
        "\x1b[31mred", str(SECRET), [], {}, [[]], [None], {"a": {}}, [1] * 50_000, "1" * 400,
    ]  # fmt: skip
    if draw.random() < 0.2:
        del node[key]
        return f"{where} gone"
    node[key] = draw.choice(values)
    return f"{where} = {str(node[key])[:20]!r}"


def _seal(tree: dict[str, Any], path: Path) -> None:
    """Make the digests hold again, as one who wants to be believed would."""
    from barsight.core.json_values import json_digest
    from barsight.result_folder import identify_map

    if path.name == "result.json":
        try:
            tree["map_id"] = identify_map(tree).map_id
        except UNREADABLE:
            return
        for name in ("bundles.json", "lifts.json"):
            _reseal(path.with_name(name), map_id=tree["map_id"])
    elif "content_sha256" in tree:
        tree["content_sha256"] = json_digest({k: v for k, v in tree.items() if k != "content_sha256"})
        if path.name == "bundles.json":
            _reseal(path.with_name("lifts.json"), bundles_sha256=tree["content_sha256"])


def _reseal(path: Path, **changes: Any) -> None:
    from barsight.core.json_values import json_digest

    if path.is_file() and not path.is_symlink() and path.stat().st_size < MAX_DAMAGED_BYTES:
        try:
            tree = json.loads(path.read_text()) | changes
        except UNREADABLE:
            return
        tree["content_sha256"] = json_digest({k: v for k, v in tree.items() if k != "content_sha256"})
        path.write_text(json.dumps(tree))


def reseal_folder(folder: Path) -> None:
    """Make result.json's digests of its files hold again, after one of them was damaged."""
    from barsight.result_folder import SEALED, file_digest

    path = folder / "result.json"
    if not path.is_file() or path.is_symlink() or path.stat().st_size > MAX_DAMAGED_BYTES:
        return
    try:
        tree = json.loads(path.read_text())
        for name in SEALED:
            if (folder / name).is_file() and (folder / name).stat().st_size < 1 << 26:
                tree["files"][name] = file_digest(folder / name)
    except UNREADABLE:
        return
    _seal(tree, path)
    path.write_text(json.dumps(tree))


def _png(path: Path, draw: random.Random) -> str:
    data = path.read_bytes()
    if not data.startswith(PNG) or len(data) < 40:
        return _bytes(path, draw)
    how = draw.choice(("size", "depth", "bomb", "chunk"))
    if how == "bomb":
        side = draw.choice((20_000, 40_000, 100_000))
        path.write_bytes(png_bomb(side, side))
        return f"{path.name}: a bomb of {side} x {side}"
    if how == "chunk":
        at = draw.randrange(33, len(data) - 12)
        body = bytearray(data)
        body[at : at + 4] = struct.pack(">I", draw.choice((0, 1, 2**31, 2**32 - 1)))
        path.write_bytes(bytes(body))
        return f"{path.name}: a length at {at}"
    body = bytearray(data[16:29])
    if how == "size":
        struct.pack_into(">II", body, 0, *(draw.choice((0, 1, 319, 65535, 2**31 - 1)) for _ in range(2)))
    else:
        body[8 + draw.randrange(5)] = draw.choice((0, 1, 2, 3, 6, 16, 255))
    path.write_bytes(data[:12] + _chunk(b"IHDR", bytes(body))[4:] + data[33:])
    return f"{path.name}: {how} in the header"


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@cache
def png_bomb(width: int, height: int) -> bytes:
    """Build a small PNG of many pixels (RGBA, 16 bits), all zero."""
    packer, row = zlib.compressobj(9), bytes(1 + 8 * width)
    parts = [packer.compress(row) for _ in range(min(height, 1200))]
    parts.append(packer.flush())
    head = struct.pack(">IIBBBBB", width, height, 16, 6, 0, 0, 0)
    return PNG + _chunk(b"IHDR", head) + _chunk(b"IDAT", b"".join(parts)) + _chunk(b"IEND", b"")


def _header(path: Path, draw: random.Random) -> str:
    data = path.read_bytes()
    text, how = draw.choice((_number, _word, _lines))(data[:400].decode("latin-1"), draw)
    path.write_bytes(text.encode("utf-8", "surrogatepass") + data[400:])
    return f"{path.name}: header, {how}"


def _bytes(path: Path, draw: random.Random) -> str:
    data = bytearray(path.read_bytes())
    how = draw.choice(("bits", "cut", "zeros", "length", "doubled", "head"))
    if not data:
        return f"{path.name}: empty"
    at = draw.randrange(min(len(data), 4096) if draw.random() < 0.5 else len(data))
    if how == "bits":
        for _ in range(draw.choice((1, 3, 20))):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    elif how == "cut":
        del data[at:]
    elif how == "zeros":
        data[at : at + draw.choice((1, 8, 512))] = bytes(8)
    elif how == "length":
        form = draw.choice(("<I", ">I", "<Q", ">H", "<d"))
        value = draw.choice((0, 1, 255, 2**15, 2**16 - 1))
        if form not in (">H", "<d"):
            value = draw.choice((value, 2**31 - 1, 2**32 - 1))
        packed = struct.pack(form, value)
        data[at : at + len(packed)] = packed
    elif how == "doubled":
        data[at:at] = data[at : at + 1000]
    else:
        data[: len(data) // 2] = data[len(data) // 2 :]
    path.write_bytes(bytes(data))
    return f"{path.name}: {how} at {at}"
