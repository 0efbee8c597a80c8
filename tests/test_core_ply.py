"""PLY vertices of every byte order come back; files that are torn or lie about their size are refused."""

from pathlib import Path

import numpy as np
import pytest

from barsight.core.reading.ply import read_vertices

FIELDS = {
    "x": "float",
    "y": "double",
    "intensity": "uchar",
    "views": "ushort",
    "label": "int32",
    "shift": "int8",
}
KINDS = {"float": "f4", "double": "f8", "uchar": "u1", "ushort": "u2", "int32": "i4", "int8": "i1"}
POINTS = [(1.5, -2.25, 255, 65535, -7, -128), (0.1, 1e-9, 0, 3, 2**31 - 1, 127)]
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def header(form: str, count: int = 2, before: str = "", after: str = "") -> bytes:
    properties = "".join(f"property {kind} {name}\n" for name, kind in FIELDS.items())
    return (
        f"ply\nformat {form} 1.0\ncomment of somebody\nobj_info 3 x\n{before}"
        f"element vertex {count}\n{properties}{after}end_header\n"
    ).encode("ascii")


def packed(order: str) -> bytes:
    return np.array(POINTS, [(name, order + KINDS[kind]) for name, kind in FIELDS.items()]).tobytes()


def assert_points(found: np.ndarray) -> None:
    assert found.dtype.names == tuple(FIELDS)
    for k, (name, kind) in enumerate(FIELDS.items()):
        assert found.dtype[name].newbyteorder("=") == np.dtype(KINDS[kind])
        np.testing.assert_array_equal(found[name], np.array([p[k] for p in POINTS], KINDS[kind]))


@pytest.mark.parametrize("form", ORDERS)
def test_binary_vertices_among_other_elements(tmp_path: Path, form: str) -> None:
    path = tmp_path / "cloud.ply"
    before, after = (
        "element camera 3\nproperty short id\n",
        "element face 1\nproperty list uchar int vertex_index\n",
    )
    path.write_bytes(header(form, 2, before, after) + b"123456" + packed(ORDERS[form]) + b"\x01\0\0\0\0")
    assert_points(read_vertices(path))
    path.write_bytes(header(form).replace(b"\n", b"\r\n") + packed(ORDERS[form]))
    assert_points(read_vertices(path))


def test_ascii_vertices_among_other_elements(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    lines = "".join(" ".join(map(repr, point)) + "\n" for point in POINTS)
    before = "element camera 2\nproperty float f\n"
    path.write_bytes(header("ascii", 2, before) + f"9.5\n8\n{lines}4 1 2 3 4\n".encode())
    assert_points(read_vertices(path))


GOOD = header("binary_little_endian") + packed("<")
TEXT = header("ascii") + b"1 2 3 4 5 6\n1 2 3 4 5 6\n"
BAD = {
    "empty": (b"", "begin with ply"),
    "another format": (b"\x89PNG\r\n\x1a\n", "begin with ply"),
    "no end": (GOOD[:60], "in the header"),
    "endless": (b"ply\n" + b"comment x\n" * 10_000, "no end"),
    "endless line": (b"ply\ncomment " + b"x" * 100_000, "no end"),
    "no format": (GOOD.replace(b"format binary_little_endian 1.0\n", b""), "no format|names no format"),
    "no vertices": (GOOD.replace(b"element vertex", b"element points"), "no element vertex"),
    "an unknown type": (GOOD.replace(b"ushort", b"half"), "half views"),
    "a property of nothing": (b"ply\nproperty float x\nend_header\n", "property float x"),
    "a name twice": (GOOD.replace(b"double y", b"double x"), "field 'x' occurs more than once"),
    "a list in the vertices": (GOOD.replace(b"property ushort", b"property list uchar ushort"), "lists"),
    "no properties": (b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n1\n", "no properties"),
    "cut short": (GOOD[:-1], "are there"),
    "a count too high": (GOOD.replace(b"vertex 2", b"vertex 99999999999999999999"), "are there"),
    "a negative count": (GOOD.replace(b"vertex 2", b"vertex -2"), "vertex -2"),
    "text cut short": (TEXT[:-12].replace(b"1 2 3 4 5 6\n", b"1000000 2000000 3 4 5 6\n"), "1 of 2"),
    "blank text": (header("ascii") + b"\n" * 100, "0 of 2"),
    "a text count too high": (TEXT.replace(b"vertex 2", b"vertex 999999999999"), "don't fit"),
    "text that is not a number": (TEXT.replace(b"5 6", b"5 six"), "six"),
    "too few numbers": (TEXT.replace(b"5 6", b"567"), "columns"),
    "a number out of range": (TEXT.replace(b"3 4", b"300 4"), "300"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused(tmp_path: Path, case: str) -> None:
    content, expected = BAD[case]
    path = tmp_path / "cloud.ply"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=expected):
        read_vertices(path)


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian"])
def test_no_vertices_are_an_empty_array(tmp_path: Path, form: str) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(header(form, 0))
    assert read_vertices(path).shape == (0,)
