"""The stock list against found bundles, bundles.json against its schema, and bad files."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from barsight.core.errors import InputError
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.inventory.bundle_file import read_bundles, read_match, write_bundles
from barsight.yard.inventory.stock_list import (
    ListedBundle,
    contradicted_bundles,
    list_contradiction,
    match_stock,
    read_stock,
    stock_text,
    stock_warnings,
)
from barsight.yard.types import Bundle, Doubt, DoubtKind
from lift_yards import GIVEN
from yard_folders import schema
from yard_maps import Laid, draw

LAID = (Laid(0.3, 0.0, 0.2, 0.2), Laid(0.9, 0.0, 0.2, -0.3), Laid(1.5, 0.1, 0.2, 0.0))


@pytest.fixture(scope="module")
def bundles() -> tuple[Bundle, ...]:
    return find_bundles(draw(list(LAID)), BundleSettings())


def test_a_bundle_that_lies_across_the_listed_one_contradicts_it(bundles: tuple[Bundle, ...]) -> None:
    """Yaw is an axis's: 180 deg is none."""
    for yaw_deg, turned in (
        (None, False),
        (2.0, False),
        (-179.0, False),
        (181.0, False),
        (20.0, True),
        (90.0, True),
    ):
        one = ListedBundle("B0", LAID[0].x_m, LAID[0].y_m, yaw_deg=yaw_deg)
        told = contradicted_bundles(match_stock((one,), bundles))
        assert ("turned by" in told.get(0, "")) is turned, yaw_deg


def test_a_list_that_fits_has_nothing_missing_moved_or_extra(bundles: tuple[Bundle, ...]) -> None:
    listed = tuple(
        ListedBundle(f"B{k}", one.x_m, one.y_m, one.top_z_m, bars=7, width_m=one.width_m)
        for k, one in enumerate(LAID)
    )
    match = match_stock(listed, bundles)
    assert [(m.name, m.bundle, m.disagrees) for m in match.matched] == [
        ("B0", 0, ()),
        ("B1", 1, ()),
        ("B2", 2, ()),
    ]
    assert (match.moved, match.missing, match.hidden, match.extra) == ((), (), (), ())
    assert contradicted_bundles(match) == {} and list_contradiction(listed, match) is None
    one_more = (*listed, ListedBundle("gone", 4.0, 0.0))
    assert list_contradiction(one_more, match_stock(one_more, bundles)) is None


def test_a_list_that_contradicts_the_map_is_told_so(bundles: tuple[Bundle, ...]) -> None:
    listed = (
        ListedBundle("shifted", 0.42, 0.0, LAID[0].top_z_m),
        ListedBundle("thinner", 0.9, 0.0, LAID[1].top_z_m, bar_diameter_m=0.02, length_m=5.0),
        ListedBundle("gone", 4.0, 0.0),
        ListedBundle("under", 1.5, 0.1, 0.1),
    )
    match = match_stock(listed, bundles)
    assert match.moved == ("shifted",)
    assert match.missing == ("gone",)
    by_name = {m.name: m for m in match.matched}
    assert by_name["shifted"].moved_m[0] == pytest.approx(-0.12, abs=0.01)
    assert len(by_name["thinner"].disagrees) == 2
    assert match.hidden == ("under",)
    assert match.extra == (2,)
    told = contradicted_bundles(match)
    assert set(told) == {0, 1, 2} and "119 mm" in told[0] and "bars' diameter" in told[1]
    assert "3 of 3 listed bundles" in (list_contradiction(listed, match) or "")
    said = stock_warnings(listed, match)
    assert said[0] == "stock list: 1 of 4 listed bundles weren't found: gone"
    assert said[1] == "stock list: 1 of 4 lie elsewhere than listed: shifted"
    assert said[2].startswith("stock list: 1 of 4 aren't as listed: thinner (bars' diameter 9")
    assert said[3] == "stock list: 1 of 4 lie under others, so the map can't tell: under"
    assert said[4:] == ("stock list: 1 of 3 found ones aren't listed, bundle: 2",)
    assert "yard's frame" in stock_warnings(listed, None)[0]


def test_an_empty_yard_lacks_everything_and_an_empty_list_makes_all_extra(
    bundles: tuple[Bundle, ...],
) -> None:
    assert match_stock((ListedBundle("a", 0.0, 0.0),), ()).missing == ("a",)
    assert match_stock((), bundles).extra == (0, 1, 2)


def test_csv_and_json_say_the_same(tmp_path: Path) -> None:
    (tmp_path / "stock.csv").write_text("name,x_m,y_m,bars,top_z_m\nA,1.0,-0.5,7,\n", encoding="utf-8")
    rows = [{"name": "A", "x_m": 1.0, "y_m": -0.5, "bars": 7}]
    (tmp_path / "stock.json").write_text(json.dumps({"bundles": rows}), encoding="utf-8")
    assert read_stock(tmp_path / "stock.csv") == read_stock(tmp_path / "stock.json")
    assert read_stock(tmp_path / "stock.csv") == (ListedBundle("A", 1.0, -0.5, bars=7),)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name,x_m\nA,1\n", "no column y_m"),
        ("name,x_m,y_m\nA,1,far\n", "y_m can't be 'far'"),
        ("name,x_m,y_m\nA,1,\n", "has no y_m"),
        ("name,x_m,y_m\n,1,2\n", "has no name"),
        ("name,x_m,y_m\nA,1,2\nA,3,2\n", "lists 'A' 2 times"),
        ("name,x_m,y_m,width_m\nA,1,2,-3\n", "width_m can't be '-3'"),
        ("name,x_m,y_m\nA,nan,2\n", "x_m can't be 'nan'"),
        ("name,x_m,y_m\nA,1e300,2\n", "x_m can't be '1e300'"),
        ("name,x_m,y_m\nB,1,2\nA,1,5,2,3\n", "bundle 2 has more fields than the header"),
        ("name,x_m,y_m,x_m\nA,1,2,3\n", "has the column x_m twice"),
        ("name,x_m,y_m,bars\nA,1,2,6.7\n", "bars can't be '6.7'"),
        ("name;x_m;y_m\nA;1,5;2,3\n", "commas between, decimals with a point"),
    ],
)
def test_a_wrong_list_is_refused_in_one_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "stock.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_stock(path)
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_a_spreadsheets_list_is_read(tmp_path: Path) -> None:
    """Byte order mark, capitals and spaces in the header, rows of nothing but commas."""
    path = tmp_path / "stock.csv"
    path.write_text("\ufeffName, X_m,y_m ,Bars\nA,1,2,7\n,,,\n", encoding="utf-8")
    assert read_stock(path) == (ListedBundle("A", 1.0, 2.0, bars=7),)


NAMES = ('Träger "40", Ø 8', "=1+1", "=cmd|' /C'!A0", "@SUM(A1)", "-a", "-12", "+49 7", "'=q", "'quote", "半")


def test_a_written_list_comes_back_and_no_spreadsheet_calculates_it(tmp_path: Path) -> None:
    """Without the mark a spreadsheet shows a name beyond ASCII garbled."""
    listed = tuple(ListedBundle(name, float(k), 2.0) for k, name in enumerate(NAMES))
    path = tmp_path / "stock.csv"
    for some in (listed, listed[1:2]):
        path.write_text(stock_text(some), encoding="utf-8")
        assert read_stock(path) == some
        with path.open(encoding="utf-8-sig", newline="") as file:
            names = [row["name"] for row in csv.DictReader(file)]
        assert not any(name[0] in "=+@" or name == "-a" for name in names) and "'12" not in str(names)
        assert path.read_bytes().startswith(b"\xef\xbb\xbf") is (some is listed)


def test_a_name_on_two_lines_is_read_as_one(tmp_path: Path) -> None:
    path = tmp_path / "stock.csv"
    path.write_text('name,x_m,y_m\n"4711\nHall 2",1,2\n', encoding="utf-8")
    assert [one.name for one in read_stock(path)] == ["4711 Hall 2"]


def test_a_missing_or_torn_list_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_stock(tmp_path / "none.csv")
    (tmp_path / "torn.json").write_text("[{", encoding="utf-8")
    with pytest.raises(InputError, match="is not a JSON"):
        read_stock(tmp_path / "torn.json")
    (tmp_path / "number.json").write_text("3", encoding="utf-8")
    with pytest.raises(InputError, match="not a list of bundles"):
        read_stock(tmp_path / "number.json")
    for text, says in (('"A", "x_m": true', "x_m can't be"), ('["A"], "x_m": 1', "has no name")):
        (tmp_path / "kinds.json").write_text(f'[{{"name": {text}, "y_m": 2}}]', encoding="utf-8")
        with pytest.raises(InputError, match=says):
            read_stock(tmp_path / "kinds.json")


def test_the_file_fits_its_schema_and_comes_back_whole(bundles: tuple[Bundle, ...], tmp_path: Path) -> None:
    path = tmp_path / "bundles.json"
    match = match_stock((ListedBundle("gone", 9.0, 0.0),), bundles)
    write_bundles(bundles, match, "yard", GIVEN, path)
    content = json.loads(path.read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema("bundles"))
    jsonschema.validate(content, schema("bundles"))
    assert content["stock"]["missing"] == ["gone"]
    assert read_match(path) == match
    for one, back in zip(bundles, read_bundles(path), strict=True):
        assert np.allclose(one.centre_m, back.centre_m, atol=1e-6)
        assert np.allclose(one.ends_m, back.ends_m, atol=1e-6)
        assert back.yaw_rad == pytest.approx(one.yaw_rad, abs=1e-8)
        assert np.isclose(back.sigma.length_m, one.sigma.length_m, equal_nan=True)
        assert 0 < one.map_sigma_z_m < 0.1
        assert back.map_sigma_z_m == pytest.approx(one.map_sigma_z_m, rel=1e-6)
        assert back.fit_sigma is not None and one.fit_sigma is not None
        assert back.fit_sigma.yaw_rad == pytest.approx(one.fit_sigma.yaw_rad, rel=1e-6)
        assert back.reasons == one.reasons and back.cover_doubts == one.cover_doubts
        assert back.neighbours == one.neighbours
        assert len(back.bar_axes) == len(one.bar_axes)


def test_doubts_come_back_with_their_kind(bundles: tuple[Bundle, ...], tmp_path: Path) -> None:
    path, told = tmp_path / "bundles.json", tuple(Doubt(kind, f"it: {kind.value} 1") for kind in DoubtKind)
    write_bundles((replace(bundles[0], reasons=told, cover_doubts=told[::-1]),), None, "yard", GIVEN, path)
    (back,) = read_bundles(path)
    assert back.reasons == told and back.cover_doubts == told[::-1]
    with pytest.raises(ValueError, match="OVERLAP"):
        Doubt(DoubtKind.OVERLAP, "it may be two")


def test_no_bundles_make_a_valid_file(tmp_path: Path) -> None:
    write_bundles((), None, "world", GIVEN, tmp_path / "bundles.json")
    content = json.loads((tmp_path / "bundles.json").read_text(encoding="utf-8"))
    jsonschema.validate(content, schema("bundles"))
    assert read_bundles(tmp_path / "bundles.json") == ()
    assert read_match(tmp_path / "bundles.json") is None


def test_a_torn_or_other_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bundles.json"
    for text, says in (
        ("{", "is not a JSON"),
        ('{"schema_version": 9}', "version 9"),
        ('{"bundles": []}', "schema_version"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=says):
            read_bundles(path)
