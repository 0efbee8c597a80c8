"""Bounds of what is read, held by what it costs; texts that give a terminal orders; files that other files
tie.
"""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from fuzz.seeds import write_results

from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import (
    MAX_WIDE_BYTES,
    read_arrays,
    read_json,
    read_lines,
    read_text,
)
from barsight.yard.inventory.stock_list import read_stock

MAX_MIB = 400
"""Of a process that refuses: the interpreter with its libraries takes 150."""


def test_a_document_of_empty_lists_takes_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(b"[" + b"[]," * 10_000_000 + b"[]]")
    code = (
        "import re, sys; from pathlib import Path; from barsight.core.errors import InputError\n"
        "from barsight.core.reading.bounded_reading import read_json\n"
        "try:\n    read_json(Path(sys.argv[1]))\nexcept InputError as error:\n    print(error)\n"
        "print(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True, timeout=60
    )
    told, peak = done.stdout.splitlines()
    assert "over 4000000 values" in told
    assert int(peak) / 1024 < MAX_MIB


def test_the_largest_document_allowed_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(b"[" + b"1," * 3_999_990 + b"1]")
    assert len(read_json(path)) == 3_999_991
    path.write_bytes(b"[" + b"1," * 4_000_000 + b"1]")
    with pytest.raises(InputError, match="over 4000000 values"):
        read_json(path)


@pytest.mark.parametrize("end", [b"\n", b"\r", b"\r\n"])
def test_lines_are_counted_whatever_ends_them(tmp_path: Path, end: bytes) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes((b"1,2" + end) * 10)
    assert read_lines(path, 10) == ["1,2"] * 10
    with pytest.raises(InputError, match="has over 9 lines"):
        read_lines(path, 9)


def test_one_letter_does_not_make_a_large_text_four_times_as_large(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes("ü".encode() + b"1\n" * (MAX_WIDE_BYTES // 2))
    with pytest.raises(InputError, match="isn't all ASCII"):
        read_text(path)
    path.write_bytes(b"1\n" * (MAX_WIDE_BYTES // 2 + 1))
    assert len(read_text(path)) > MAX_WIDE_BYTES


def test_an_archive_of_many_arrays_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(10_001):
            archive.writestr(f"{number}.npy", b"")
    with pytest.raises(InputError, match="holds 10001 arrays"):
        read_arrays(path)


@pytest.mark.parametrize(
    "words",
    [["info", "a", "b\x1b[31mred"], ["fleet", "plan", "a", "--results", "b", "--limit", "\x1b]0;x\x07"]],
)
def test_arguments_give_the_terminal_no_orders(capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    with pytest.raises(SystemExit) as leaving:
        run(words)
    assert leaving.value.code == 2
    told = "".join(capsys.readouterr())
    assert "?" in told and not any(sign < " " and sign != "\n" for sign in told)


def test_a_name_with_odd_signs_still_names_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_results(tmp_path / "o\x1but", 0.0)
    assert run(["export", str(tmp_path / "o\x1but"), str(tmp_path / "m\x07ade.ply")]) == 0
    assert (tmp_path / "m\x07ade.ply").is_file()
    assert "\x07" not in capsys.readouterr().err


def test_tifffile_tells_nothing_beside_our_line(tmp_path: Path) -> None:
    write_results(tmp_path / "out", 0.0)
    path = tmp_path / "out" / "height.tif"
    data = bytearray(path.read_bytes())
    data[12:14] = b"\xff\xff"  # the kind of the first tag, the width
    path.write_bytes(bytes(data))
    command = [sys.executable, "-m", "barsight", "explain", str(tmp_path / "out"), "1"]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 3
    assert done.stderr.count("\n") == 1 and "height.tif" in done.stderr


def test_score_names_the_torn_contour(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_results(tmp_path / "out", 0.0)
    path = tmp_path / "out" / "contour.csv"
    lines = path.read_text().splitlines()
    for damaged in (["profile,x_m"], [*lines[:50], lines[50][:9]], [lines[0], "0,1,2,3,4,x"]):
        path.write_text("\n".join(damaged) + "\n")
        code = run(["score", str(whole), str(tmp_path / "out")])
        told = capsys.readouterr().err
        assert (code == 3 and "contour.csv: " in told) or damaged == ["profile,x_m"]


def test_a_stock_list_of_too_many_is_refused_before_it_is_matched(tmp_path: Path) -> None:
    path = tmp_path / "stock.csv"
    path.write_text("name,x_m,y_m\n" + "".join(f"{number},1,2\n" for number in range(10_001)))
    with pytest.raises(InputError, match="lists 10001 bundles, at most 10000"):
        read_stock(path)
