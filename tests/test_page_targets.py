"""Targets picked on a survey's photo: placed or refused by name, fitted, written for `calibrate yard`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.page.api.serve import ServeOptions, serving
from barsight.page.targets import Pick, place_pick
from barsight.registration.rigid import design_rows
from barsight.registration.surveyed_targets import read_targets
from barsight.registration.yard import predicted_covariance
from barsight.registration.yard_file import read_yard_file
from barsight.store.accounts import add_person
from barsight.store.audit import entry
from barsight.store.opening import open_store
from barsight.yard.types import HeightMap
from lift_yards import sure_travel
from page_yards import DISCS, SECOND
from yard_maps import draw

PASSWORD = "four words that nobody guesses"
TURN, SHIFT = Rotation.from_euler("z", 40, degrees=True).as_matrix(), np.array([100.0, 20.0, 0.5])
PLACES = np.array([(x, y, 0.0) for x, y in DISCS])
HEADER = "name,yard_x,yard_y,yard_z,sigma_m,check\n"
TRUE = PLACES @ TURN.T + SHIFT
LISTED = HEADER + "".join(
    f'"post, {k}",{x:.5f},{y:.5f},{z:.5f},,{int(k == 3)}\n' for k, (x, y, z) in enumerate(TRUE)
)


def clicks(numbers: range, aside_m: float = 0.02) -> list[dict[str, object]]:
    return [
        {"name": f"post, {k}", "x_m": DISCS[k][0] + aside_m, "y_m": DISCS[k][1] - aside_m} for k in numbers
    ]


TWICE = [*clicks(range(1)), clicks(range(1))[0] | {"name": "post, 1"}]


@pytest.fixture(scope="module")
def local(made: Path) -> Iterator[httpx.Client]:
    """An engineer at this computer."""
    url = f"sqlite:///{made / 'yard.db'}"
    with serving(url, ServeOptions(port=0)) as address, httpx.Client(base_url=address) as client:
        client.headers["X-Barsight-Token"] = client.get("/api/session").json()["token"]
        yield client


@pytest.fixture(scope="module")
def path(local: httpx.Client) -> str:
    return f"/api/surveys/{local.get('/api/surveys').json()['surveys'][0]['map_id']}"


def asked(
    client: httpx.Client, path: str, picks: list[dict[str, object]], listed: str = LISTED
) -> httpx.Response:
    return client.post(f"{path}/targets", json={"listed": listed, "sigma_m": 0.001, "picks": picks})


def test_clicks_beside_discs_place_the_yard(
    local: httpx.Client, path: str, made: Path, tmp_path: Path
) -> None:
    told = asked(local, path, clicks(range(4))).json()
    assert [one["name"] for one in told["names"] if one["check"]] == ["post, 3"]
    for one, place in zip(told["targets"], PLACES, strict=True):
        assert one["found"] == "disc"
        off = np.array(one["place_m"]) - place
        assert np.hypot(*off[:2]) < 0.0008 and abs(off[2]) < 0.002
        assert np.linalg.norm(one["off_m"]) < 0.006
    assert told["fit"]["scale"] == pytest.approx(1, abs=0.001) and told["fit"]["doubts"] == []
    listed = tmp_path / "targets.csv"
    listed.write_text(told["csv"], encoding="utf-8")
    assert read_targets(listed).names == tuple(f"post, {k}" for k in range(4))
    out = tmp_path / "yard.yaml"
    assert run(["calibrate", "yard", str(listed), "--measured", str(made / "second"), "-o", str(out)]) == 0
    frame = read_yard_file(out)
    assert np.linalg.norm(frame.yard_from.apply(PLACES) - TRUE, axis=1).max() < 0.003
    assert told["fit"]["turn_sigma_deg"] == pytest.approx(
        np.degrees(np.sqrt(np.linalg.eigvalsh(frame.covariance[:3, :3])[-1])), rel=1e-2
    )


def test_few_picks_are_placed_but_not_fitted(local: httpx.Client, path: str) -> None:
    for picks in ([], clicks(range(2)), clicks(range(1, 4))):
        told = asked(local, path, picks).json()
        assert len(told["names"]) == 4 and len(told["targets"]) == len(picks)
        assert told["fit"] is None and told["csv"] is None


def test_a_pick_by_hand_stays_where_it_is_and_is_less_sure(local: httpx.Client, path: str) -> None:
    by_hand = clicks(range(1))[0] | {"is_exact": True}
    (one,) = asked(local, path, [by_hand]).json()["targets"]
    (other,) = asked(local, path, clicks(range(1))).json()["targets"]
    assert one["found"] == "hand" and one["place_m"][:2] == [by_hand["x_m"], by_hand["y_m"]]
    assert [one["sigma_m"][0], other["sigma_m"][0]] == pytest.approx([0.007, 0.0012])
    assert one["sigma_m"][2] == pytest.approx(0.0028, abs=3e-4)


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ((-9.0, 0.0), "post, 0: its pick lies outside the map; pick a place in it"),
        ((-1.2, 0.0), "post, 0: its pick lies where no height was measured; pick a place that was"),
        ((SECOND[0].x_m - SECOND[0].width_m / 2, 0.0), "post, 0: about its pick the height jumps by 0."),
    ],
)
def test_a_place_that_no_target_can_have_is_refused_by_name(
    local: httpx.Client, path: str, place: tuple[float, float], reason: str
) -> None:
    answer = asked(local, path, [{"name": "post, 0", "x_m": place[0], "y_m": place[1]}])
    assert answer.status_code == 409 and reason in answer.json()["problem"]


@pytest.mark.parametrize(
    ("listed", "picks", "reason"),
    [
        ("where,x\n", [], "list of places: has no column name; give name,yard_x,yard_y,yard_z"),
        (HEADER + "a,1,2,x\n", [], "list of places: line 2: a number is missing or is none"),
        (HEADER + "a,1,2,3\na,1,2,3\n", [], "list of places: target a is there twice; give each target once"),
        (HEADER, [], "list of places: has no target"),
        (LISTED, [{"name": "b", "x_m": 0, "y_m": 0}], "b: is picked but isn't in the list"),
        (LISTED, clicks(range(1)) * 2, "post, 0: is picked twice; pick it once"),
        (LISTED, TWICE, "post, 1: is picked where post, 0 is; pick each where it is"),
    ],
)
def test_a_list_that_cannot_be_is_refused(
    local: httpx.Client, path: str, listed: str, picks: list[dict[str, object]], reason: str
) -> None:
    answer = asked(local, path, picks, listed)
    assert answer.status_code == 409 and reason in answer.json()["problem"]


def test_forms_and_surveys_that_cannot_be_are_refused(local: httpx.Client, path: str) -> None:
    for body in ({"listed": LISTED, "sigma_m": 0, "picks": []}, {"listed": "", "sigma_m": 1e-3, "picks": []}):
        assert local.post(f"{path}/targets", json=body).status_code == 422
    body = json.dumps({"listed": LISTED, "sigma_m": 0.001, "picks": clicks(range(1))})
    for number, status in (("-0.98", 409), ("0.001", 422)):
        no_number = body.replace(number, "NaN")
        assert no_number.count("NaN") == 1
        kind = {"content-type": "application/json"}
        answer = local.post(f"{path}/targets", content=no_number, headers=kind)
        assert answer.status_code == status and answer.json()["problem"]
    assert asked(local, "/api/surveys/none", []).status_code == 404
    assert local.get("/api/surveys/none/targets").status_code == 404


def test_the_photo_is_shown_cell_by_cell(local: httpx.Client, path: str) -> None:
    grid = local.get(f"{path}/targets").json()
    column = round((DISCS[0][0] - grid["left_m"]) / grid["cell_m"] - 0.5)
    row = round((DISCS[0][1] - grid["low_m"]) / grid["cell_m"] - 0.5)
    box = {"left": column - 20, "right": column + 30, "low": row - 20, "high": row + 25}
    shown = cv2.imdecode(
        np.frombuffer(local.get(f"{path}/photo.png", params=box).content, np.uint8), cv2.IMREAD_UNCHANGED
    )
    assert shown.shape == (45, 50, 4) and (shown[..., 3] == 255).all()
    assert shown[24, 20, 0] == 30 and shown[24, 32, 0] == 220 and shown[12, 20, 0] == 220
    for wrong in ({"right": grid["columns"] + 1}, {"left": -1}, {"high": row - 20}):
        answer = local.get(f"{path}/photo.png", params=box | wrong)
        assert answer.status_code == 422 and "the map has" in answer.json()["problem"]


def test_only_engineers_pick_and_a_folder_that_was_changed_is_refused(made: Path, tmp_path: Path) -> None:
    shutil.copy(made / "yard.db", tmp_path / "yard.db")
    url = f"sqlite:///{tmp_path / 'yard.db'}"
    with open_store(url) as store, entry(store, "ann", "accounts") as opened:
        add_person(opened, "ann", "engineer", PASSWORD)
        add_person(opened, "oli", "operator", PASSWORD)
    for name, status in (("oli", 403), ("ann", 200)):
        with serving(url, ServeOptions(port=0)) as address, httpx.Client(base_url=address) as client:
            known = client.post("/api/session", json={"name": name, "password": PASSWORD}).json()
            path = f"/api/surveys/{client.get('/api/surveys').json()['surveys'][0]['map_id']}"
            assert asked(client, path, clicks(range(4))).status_code == 403, "no token"
            client.headers["X-Barsight-Token"] = known["token"]
            assert asked(client, path, clicks(range(4))).status_code == status
            assert client.get(f"{path}/targets").status_code == status


def test_coarser_pixels_than_cells_make_a_pick_less_sure() -> None:
    """Pixels of 6.4 and 12.8 mm on the floor; the cells are 10 mm."""
    heights, stamps = draw([], sigma_m=0.002), np.arange(2, dtype=np.int64)
    travel = sure_travel(np.zeros((2, 2)), stamps)
    for eye_z_m, sigma_m in ((8.0, 0.007), (16.0, 0.7 * 0.0128)):
        found = place_pick(heights, replace(travel, eye_z_m=eye_z_m), Pick("a", 0.5, 0.5))
        assert found.sigma_m[:2] == pytest.approx(sigma_m, abs=5e-6)


def standing(x_m: float, y_m: float, wide_m: float, turn_deg: float, *, is_round: bool = False) -> HeightMap:
    """A column 1.1 m high, 10 mm wider all round as matching has it; a hole in its top."""
    heights = draw([], x_m=(-1.0, 1.0), y_m=(-1.0, 1.0), sigma_m=0.003, seed=11)
    x, y = np.meshgrid(heights.x_m - x_m, heights.y_m - y_m)
    turned = np.exp(1j * np.radians(turn_deg)) * (x + 1j * y)
    across = np.abs(turned) if is_round else np.maximum(np.abs(turned.real), np.abs(turned.imag))
    heights.z_m[across < wide_m / 2 + 0.01] += 1.1
    heights.z_m[np.hypot(x - 0.05, y) < 0.03] = np.nan
    return heights


@pytest.mark.parametrize("is_round", [False, True])
def test_a_column_is_placed_by_the_middle_of_its_top(is_round: bool) -> None:
    """A round one's width is listed as the side of a square of its area."""
    for k, (x, y, wide) in enumerate([(0.123, -0.256, 0.3), (-0.301, 0.208, 0.22), (0.0, 0.004, 0.5)]):
        heights = standing(x, y, wide, 25.0 * k, is_round=is_round)
        listed = wide * (np.pi**0.5 / 2 if is_round else 1)
        found = place_pick(heights, None, Pick("column", x - 0.06, y + 0.07, width_m=listed))
        assert found.found == "column" and found.place_m[2] == pytest.approx(1.1, abs=0.002)
        assert np.hypot(*(found.place_m[:2] - (x, y))) < 0.0035
        assert found.sigma_m == pytest.approx([0.0036, 0.0036, 0.0042], abs=6e-4)
        wider = place_pick(heights, None, Pick("column", x, y, width_m=listed + 0.04))
        assert wider.sigma_m[0] == pytest.approx(np.hypot(0.0035, 0.02), abs=2e-3)


@pytest.mark.parametrize(
    ("pick", "reason"),
    [
        (
            Pick("a", 0.1, 0.1, width_m=0.2),
            "a: where it is picked no column of 0.2 m ends: the level place is 0.32 m wide",
        ),
        (Pick("a", 0.1, 0.1, width_m=0.5), "no column of 0.5 m ends: the level place is 0.32 m wide"),
        (Pick("a", -0.7, 0.4, width_m=0.3), "no column of 0.3 m ends: the level place is 0.9"),
        (Pick("a", 0.15, 0.1, width_m=0.3), "a: where its column is picked no height was measured"),
    ],
)
def test_a_place_where_no_such_column_ends_is_refused(pick: Pick, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        place_pick(standing(0.1, 0.1, 0.3, 0.0), None, pick)


def test_the_list_says_which_targets_are_columns(local: httpx.Client, path: str) -> None:
    """On the floor no column ends; taken as that very place it is a target like others."""
    listed = "name,yard_x,yard_y,yard_z,width_m\na,0,0,0,0.3\nb,1,0,0,\n"
    picks = [{"name": name, "x_m": 2.0 + k, "y_m": 0.0, "is_exact": k > 0} for k, name in enumerate("ab")]
    answer = asked(local, path, picks, listed)
    assert (
        answer.status_code == 409
        and "a: where it is picked no column of 0.3 m ends" in answer.json()["problem"]
    )
    told = asked(local, path, [picks[0] | {"is_exact": True}, picks[1]], listed).json()
    assert [one["found"] for one in told["targets"]] == ["hand", "hand"]
    answer = asked(local, path, [], listed.replace("0.3", "-0.3"))
    assert "line 2: a value is out of range; places finite, sigma_m" in answer.json()["problem"]


@pytest.mark.slow
def test_rendered_columns_place_the_yard(tmp_path: Path) -> None:
    """Six columns, two of them checks, clicked up to 50 mm beside their axes."""
    at = [
        (0.2, -1.1, 1.3), (1.9, 1.2, 1.1), (3.5, -0.9, 1.5), (0.5, 1.3, 1.2), (2.2, -0.2, 1.4),
        (3.3, 1.1, 1.0),
    ]  # fmt: skip
    widths, rng = (0.3, 0.25, 0.35, 0.4, 0.22, 0.3), np.random.default_rng(8720)
    plates = (
        f'[[plate]]\nname = "column {k}"\nx_m = {x}\ny_m = {y}\nz_m = {z}\n'
        f"size_m = [{widths[k]}, {widths[k]}]\nyaw_deg = {25 * k}\n"
        for k, (x, y, z) in enumerate(at)
    )
    (tmp_path / "plan.toml").write_text("".join(plates))
    camera = ("--camera.width-px", "640", "--camera.height-px", "512", "--camera.focal-px", "625")
    words = ("--length", "3.6", "--frames", "12", "--seed", "8720", "--depth-views", "0", *camera)
    recording, out = str(tmp_path / "recording"), str(tmp_path / "out")
    more = ("--camera.above-floor-m", "6", "--artefacts", str(tmp_path / "plan.toml"))
    assert run(["simulate", recording, *words, *more]) == 0
    over_edges = ("--stereo.barsight.refinement.alike-gray", "1000")
    assert run(["measure", recording, "-o", out, *over_edges]) == 0
    url = f"sqlite:///{tmp_path / 'yard.db'}"
    assert run(["store", "add", url, out]) == 0
    true = np.array(at) @ TURN.T + SHIFT
    survey = true + rng.normal(0, 0.001, true.shape)
    listed = "name,yard_x,yard_y,yard_z,sigma_m,check,width_m\n" + "".join(
        f"column {k},{x:.5f},{y:.5f},{z:.5f},0.001,{int(k > 3)},{widths[k]}\n"
        for k, (x, y, z) in enumerate(survey)
    )
    beside = np.array(at)[:, :2] + rng.uniform(-0.05, 0.05, (6, 2))
    picks: list[dict[str, object]] = [
        {"name": f"column {k}", "x_m": x, "y_m": y} for k, (x, y) in enumerate(beside.tolist())
    ]
    with serving(url, ServeOptions(port=0)) as address, httpx.Client(base_url=address) as client:
        client.headers["X-Barsight-Token"] = client.get("/api/session").json()["token"]
        map_id = client.get("/api/surveys").json()["surveys"][0]["map_id"]
        told = asked(client, f"/api/surveys/{map_id}", picks, listed).json()
    for one, place in zip(told["targets"], at, strict=True):
        off = np.array(one["place_m"]) - place
        assert one["found"] == "column" and (np.abs(off) < 3 * np.array(one["sigma_m"])).all()
        assert np.abs(off[:2]).max() < 0.01
    (tmp_path / "targets.csv").write_text(told["csv"])
    yard = tmp_path / "yard.yaml"
    words = ("calibrate", "yard", str(tmp_path / "targets.csv"), "--measured", out, "-o", str(yard))
    assert run([*words]) == 0
    frame = read_yard_file(yard)
    assert frame.doubts == ()
    off_m = np.linalg.norm(frame.yard_from.apply(np.array(at)) - true, axis=1)
    design = design_rows(np.array(at) @ frame.yard_from.rotation.T)
    spread_m2 = predicted_covariance(design, frame.covariance, np.zeros(6), np.ones(6, bool))
    sigma_m = np.sqrt(np.trace(spread_m2, axis1=1, axis2=2) / 3)
    assert off_m.max() < 0.02 and (off_m < 2 * 3**0.5 * sigma_m).all()
