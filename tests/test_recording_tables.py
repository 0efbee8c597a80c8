"""The CSV reader: exact, fast, tolerant of harmless variants, and it names the line that is wrong."""

import time
from pathlib import Path

import numpy as np
import pytest

from barsight.core.errors import InputError
from barsight.recording.formats.euroc_tables import read_image_list, read_table

COLUMNS = ("timestamp", "a", "b")
GOOD = "#timestamp [ns],a,b\n1403715273262142977,1.5,-2e-3\n1403715273262142979,0.1,7\n"


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "data.csv"
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        GOOD,
        GOOD.replace("\n", "\r\n"),
        "\ufeff" + GOOD,
        GOOD.lstrip("#"),
        GOOD.rstrip("\n"),
        GOOD.replace("\n14", "\n\n14"),
        GOOD.replace(",", ", "),
        GOOD + "# the end\n\n",
    ],
    ids=["plain", "crlf", "bom", "header without #", "no last newline", "blank lines", "spaces", "comment"],
)
def test_harmless_variants_read_the_same(tmp_path: Path, text: str) -> None:
    table = read_table(written(tmp_path, text), COLUMNS)
    assert table.first.tolist() == [1403715273262142977, 1403715273262142979]
    np.testing.assert_array_equal(table.rest, [[1.5, -2e-3], [0.1, 7.0]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no rows"),
        ("#timestamp [ns],a,b\n", "has no rows"),
        (GOOD + "\n1403715273262142981,1\n", "line 5: 2 columns, expected 3"),
        (GOOD + "1403715273262142981,1,2,3\n", "line 4: 4 columns, expected 3"),
        (GOOD + "1403715273262142981,1,2,\n", "line 4: 4 columns, expected 3"),
        (GOOD + "1403715273262142981,1,wide\n", "line 4: b 'wide' is not a number"),
        (GOOD + "1403715273262142981,,2\n", "line 4: a '' is not a number"),
        (GOOD + "1403715273.262,1,2\n", "line 4: timestamp '1403715273.262' is not a whole number"),
        (GOOD + "99999999999999999999,1,2\n", "line 4: timestamp '99999999999999999999' is not"),
        (GOOD + "\x00\x00\x00", "line 4"),
    ],
)
def test_a_wrong_line_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        read_table(written(tmp_path, text), COLUMNS)
    assert message in str(caught.value)
    assert "data.csv" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_values_that_are_not_finite_are_named(tmp_path: Path, value: str) -> None:
    table = read_table(written(tmp_path, GOOD.replace("0.1", value)), COLUMNS)
    with pytest.raises(InputError, match="line 3: a value is NaN, infinite or too large"):
        table.expect_finite("mend it")


@pytest.mark.parametrize(
    ("last", "message"),
    [("1403715273262142979", "line 5: .*same as the one before"), ("5", "line 5: .*goes back in time")],
)
def test_stamps_out_of_order_are_named(tmp_path: Path, last: str, message: str) -> None:
    table = read_table(written(tmp_path, f"{GOOD}\n{last},1,2\n"), COLUMNS)
    with pytest.raises(InputError, match=message):
        table.expect_increasing()


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_table(tmp_path / "data.csv", COLUMNS)


def test_further_columns_are_ignored_where_allowed(tmp_path: Path) -> None:
    path = written(tmp_path, GOOD.replace("\n14", "\n14").replace(",7", ",7,8").replace("e-3", "e-3,9"))
    assert read_table(path, COLUMNS, extra_allowed=True).rest.tolist() == [[1.5, -2e-3], [0.1, 7.0]]


def test_image_list(tmp_path: Path) -> None:
    path = written(tmp_path, "#timestamp [ns],filename\r\n7, a b.png\r\n\r\n9,c.png\r\n")
    stamps, names = read_image_list(path)
    assert stamps.tolist() == [7, 9]
    assert names == ("a b.png", "c.png")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("#timestamp [ns],filename\n", "has no rows"),
        ("7,a.png\n8\n", "line 2: expected `stamp,filename`"),
        ("7,a.png\n8.5,b.png\n", "line 2: the stamp '8.5'"),
        ("7,a.png\n\n7,b.png\n", "line 3: stamp 7 is the same"),
        ("7,a.png\n5,b.png\n", "line 2: stamp 5 goes back"),
    ],
)
def test_image_list_names_the_wrong_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        read_image_list(written(tmp_path, text))
    assert message in str(caught.value)


@pytest.mark.slow
def test_an_hour_of_imu_reads_in_seconds(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).normal(size=(720_000, 6))
    lines = [
        f"{1403715273262142977 + 5_000_000 * k},{','.join(map(repr, row))}"
        for k, row in enumerate(rows.tolist())
    ]
    path = written(tmp_path, "\n".join(lines) + "\n")
    begin = time.process_time()
    table = read_table(path, ("timestamp", *"abcdef"))
    assert time.process_time() - begin < 3.0
    np.testing.assert_array_equal(table.rest, rows)
    assert table.first[-1] == 1403715273262142977 + 5_000_000 * 719_999
