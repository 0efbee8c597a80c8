"""The page's API: who may do what, whose requests are refused, and which confirmations hold."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import httpx
import numpy as np
import pytest
from sqlalchemy import select

from barsight.cli.main import run
from barsight.core.errors import ConfigError, InputError
from barsight.core.stamps import NS_PER_S
from barsight.page.access import Access, AccessError, Throttle
from barsight.page.api.serve import ServeOptions, serve, serving
from barsight.page.conditions import find_conditions
from barsight.page.documents import alarm_records, lift_records, unseen_lengths
from barsight.page.layers import find_layers, newest_at, paint_layer
from barsight.page.live import LiveFolder
from barsight.page.watch import StoreWatch
from barsight.store import accounts, confirmation
from barsight.store.adding import add_survey, read_survey
from barsight.store.audit import AuditChain, Entry, entry, verify_chain
from barsight.store.calibrations import approve_calibration, note_calibration
from barsight.store.history import list_surveys, present_yard
from barsight.store.opening import open_store
from barsight.store.states import alarm_state, last_raised_ns, raise_alarm, step_alarm, step_lift
from barsight.store.tables import ALARMS, LIFT_BUNDLES, LIFTS
from barsight.yard.inventory.stock_list import match_stock, read_stock
from live_folders import live_folder
from page_yards import FIRST, SECOND, survey

PASSWORD = "four words that nobody guesses"
CHANGES = [
    ("POST", "/api/lifts/{lift}/confirm", {"map_id": "{map}"}, "operate"),
    ("POST", "/api/lifts/{lift}/taken", {}, "execute"),
    ("POST", "/api/lifts/{lift}/end", {"state": "failed", "note": "slipped"}, "execute"),
    ("POST", "/api/alarms/{alarm}/acknowledge", {"note": ""}, "operate"),
    ("POST", "/api/alarms/{alarm}/clear", {"note": ""}, "report"),
    ("POST", "/api/alarms", {"code": "rig", "reason": "loose"}, "report"),
    ("POST", "/api/stock", {"map_id": "{map}", "key": "missing A4", "decision": "accepted"}, "operate"),
    ("POST", "/api/accounts", {"name": "x", "kind": "token", "role": "viewer"}, "administer"),
    ("DELETE", "/api/accounts/eve", None, "administer"),
    ("GET", "/api/accounts", None, "administer"),
    ("POST", "/api/calibrations", {"digest": "ca1b"}, "administer"),
    ("POST", "/api/vetoes", {"code": "disturbed", "reason": "a lorry"}, "report"),
]
MAY = {
    "viewer": set(),
    "operator": {"operate", "execute"},
    "service": {"execute", "report"},
    "engineer": {"operate", "execute", "report", "administer"},
}
"""Said again here, not read from the code: who may what."""


@pytest.fixture
def local(url: str) -> Iterator[httpx.Client]:
    """A browser on this computer, before there are accounts."""
    with serving(url, ServeOptions(port=0)) as address, httpx.Client(base_url=address) as client:
        client.headers["X-Barsight-Token"] = client.get("/api/session").json()["token"]
        yield client


def offered(client: httpx.Client) -> list[dict[str, object]]:
    lifts = client.get("/api/lifts").json()["lifts"]
    return sorted((one for one in lifts if one["state"] == "offered"), key=lambda one: one["rank"])


def state_of(client: httpx.Client, number: object) -> str:
    return next(one["state"] for one in client.get("/api/lifts").json()["lifts"] if one["id"] == number)


def test_what_the_page_reads(local: httpx.Client) -> None:
    state = local.get("/api/state").json()
    assert state["offered"] == 3 and state["claimed"] == 0
    bundles = {one["identity"]: one for one in local.get("/api/bundles").json()["bundles"]}
    assert set(bundles) == {"B1", "B2", "B3", "B5", "B6"}
    assert bundles["B1"]["lift"]["rank"] and not bundles["B1"]["vetoes"]
    assert {veto["code"] for veto in bundles["B6"]["vetoes"]} >= {"end-open"}
    assert [one["code"] for one in local.get("/api/alarms").json()["alarms"]] == ["bundle-gone"]
    stock = local.get("/api/stock").json()
    assert stock["agree"] == ["A1", "A2", "A3"]
    assert {one["key"] for one in stock["differences"]} == {"missing A4", "extra B5", "extra B6"}
    history = local.get("/api/bundles/B1").json()["history"]
    assert [one["what"] for one in history] == ["found", "same"]
    first, second = (one["captured_to_ns"] for one in local.get("/api/surveys").json()["surveys"][::-1])
    changes = local.get("/api/compare", params={"before_ns": first, "after_ns": second}).json()["changes"]
    assert {(one["identity"], one["what"]) for one in changes} == {("B4", "went"), ("B6", "came")}
    past = local.get("/api/yard", params={"at_ns": first}).json()
    assert {one["identity"] for one in past["bundles"]} == {"B1", "B2", "B3", "B4", "B5"}
    layer = local.get("/api/layers").json()["layers"][-1]
    picture = local.get(f"/api/layers/{layer['map_id']}.png")
    assert picture.content.startswith(b"\x89PNG")
    assert local.get("/api/bundles/B99").status_code == 404
    shot = local.get(f"/api/bundles/B1/pictures/{layer['map_id']}.png")
    gray = cv2.imdecode(np.frombuffer(shot.content, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert gray.shape[1] > 2 * gray.shape[0], "the bundle lies along its picture"
    middle = gray[gray.shape[0] // 2]
    assert middle[100:-100].mean() > middle[[20, -20]].mean() + 30, "it is higher, so lighter, than the floor"
    assert local.get(f"/api/bundles/B4/pictures/{layer['map_id']}.png").status_code == 404
    assert bundles["B1"]["unseen_m"] is None and bundles["B6"]["unseen_m"] is None
    assert "/api/lifts/{lift_id}/confirm" in local.get("/openapi.json").json()["paths"]


def test_two_servers_of_which_one_watches_the_live_run_do_not_alarm_by_turns(
    url: str, tmp_path: Path
) -> None:
    with open_store(url) as store:
        watching, other = StoreWatch(store, LiveFolder(tmp_path / "none")), StoreWatch(store)
        for _ in range(4):
            watching.judge()
            other.judge()
        with store.reading() as connection:
            raised = select(ALARMS.c.id).where(ALARMS.c.code == "live-stopped").order_by(ALARMS.c.id)
            told = [alarm_state(connection, one) for one in connection.execute(raised).scalars()]
            listed = [one["state"] for one in alarm_records(connection) if one["code"] == "live-stopped"]
    assert told == ["returned", "raised"], "what an earlier server has left ends at the start, once"
    assert listed == ["raised"]


def test_the_yards_clock_goes_on_while_nothing_changes(
    local: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, now_ns = local.get("/api/state").json(), time.time_ns
    later_ns = 7200 * NS_PER_S
    monkeypatch.setattr("barsight.page.watch.time.time_ns", lambda: now_ns() + later_ns)
    monkeypatch.setattr("barsight.page.watch.StoreWatch.judge", lambda *_, **__: None)
    later = local.get("/api/state").json()
    assert later["revision"] == first["revision"], "nothing was added meanwhile"
    assert abs(later["clock_ns"] - first["clock_ns"] - later_ns) < 2 * NS_PER_S


@pytest.mark.parametrize(
    ("method", "path", "content", "wanted"),
    [
        ("GET", f"/api/yard?at_ns={2**63}", "", "query.at_ns: "),
        ("GET", f"/api/stock.csv?at_ns=-{2**70}", "", "query.at_ns: "),
        ("GET", "/api/bundles/B\u00b2", "", "there is no bundle B"),
        ("POST", f"/api/lifts/{2**31}/taken", "", "path.lift_id: "),
        ("POST", f"/api/alarms/{2**70}/clear", "{}", "path.alarm_id: "),
        ("POST", "/api/lifts/1/confirm", '{"map_id": "\\ud800"}', "body.map_id: "),
        ("POST", "/api/session", '{"name": "ann", "password": "\\ud800"}', "body.password: "),
        ("POST", "/api/vetoes", '{"code": "\\ud800", "reason": "x"}', "body.code: "),
        ("POST", "/api/alarms", '{"code": "a", "reason": "x\\u0000"}', "body.reason: "),
    ],
)
def test_what_no_store_can_hold_is_refused_in_one_line(
    local: httpx.Client, method: str, path: str, content: str, wanted: str
) -> None:
    answer = local.request(
        method, path, content=content.encode(), headers={"Content-Type": "application/json"}
    )
    assert answer.status_code in (404, 422) and answer.json()["problem"].startswith(wanted)


def test_how_far_an_open_end_may_lie_is_told_by_bars_alike() -> None:
    bar = {"bar_diameter_m": 0.05, "width_m": 0.3, "length_m": 6.0, "ends_open": [False, False]}
    cut = bar | {"length_m": 5.2, "ends_open": [False, True]}
    thick = cut | {"bar_diameter_m": 0.08}
    unknown = cut | {"bar_diameter_m": None}
    longer = cut | {"length_m": 6.5}
    told = unseen_lengths([bar, bar | {"length_m": 6.02}, cut, thick, unknown, longer])
    assert told == [None, None, pytest.approx(0.81), None, None, None]


def read_events(client: httpx.Client, kind: str, act: Callable[[], object]) -> list[str]:
    """Read events of a kind: the first one, and the one that comes when `act` was called."""
    said: list[str] = []
    end_s = time.monotonic() + 30
    with client.stream("GET", "/api/events", timeout=5) as answer:
        wanted = False
        for line in answer.iter_lines():
            assert time.monotonic() < end_s, f"beats, but no second event of {kind}"
            if line.startswith("event:"):
                wanted = line == f"event: {kind}"
            elif line.startswith("data:") and wanted:
                said.append(line[6:])
                if len(said) == 2:
                    return said
                act()
    return said


def test_crane_and_magnet_are_told_as_the_live_run_tells_them(url: str, tmp_path: Path) -> None:
    """A crane's surveys have a folder each, `current` is the one that runs; a silent run has no place."""
    (tmp_path / "live").mkdir()
    live = live_folder(tmp_path / "live" / "one", now_ns=10_000_000_000, crane_m=[2.4, 1.1, 7.0])
    (tmp_path / "live" / "current").symlink_to(live)
    options = ServeOptions(port=0, live=tmp_path / "live")
    is_silent, old_s = threading.Event(), time.time() - 5

    def run() -> None:
        while not is_silent.wait(0.1):
            os.utime(live / "state.json")
        os.utime(live / "state.json", (old_s, old_s))

    runs = threading.Thread(target=run)
    runs.start()
    with serving(url, options) as address, httpx.Client(base_url=address) as client:
        try:
            moving, silent = read_events(client, "crane", is_silent.set)
        finally:
            is_silent.set()
            runs.join()
        newest = client.get("/api/state").json()["survey"]["captured_to_ns"]
    place = {"body_m": [3.0, 1.0], "magnet_m": [2.4, 1.1], "map_seen_ns": newest}
    assert json.loads(moving) == {"mode": "full", "reasons": [], "place": place}
    assert json.loads(silent) == {"mode": None, "reasons": [], "place": None}


def test_a_lift_from_the_offer_to_the_next_survey(local: httpx.Client, url: str, tmp_path: Path) -> None:
    first, second = offered(local)[:2]
    confirm = {"map_id": first["map_id"], "name": "Ann"}
    assert local.post(f"/api/lifts/{second['id']}/taken", json={}).status_code == 409
    assert local.post(f"/api/lifts/{first['id']}/confirm", json=confirm).status_code == 200
    assert local.post(f"/api/lifts/{first['id']}/confirm", json=confirm).status_code == 409
    assert local.get("/api/state").json()["claimed"] == 1
    assert local.post(f"/api/lifts/{first['id']}/taken", json={}).status_code == 200
    # Its neighbour lies 1.1 m further on: what stood beside the moved bundle is disturbed.
    assert {state_of(local, one["id"]) for one in offered(local)} <= {"offered"}
    lift = next(one for one in local.get("/api/lifts").json()["lifts"] if one["id"] == first["id"])
    assert [step["state"] for step in lift["steps"]] == ["offered", "claimed", "executed"]
    assert lift["steps"][1]["who"] == "Ann (no account)"
    lies = [one for k, one in enumerate(SECOND) if f"B{k + 1}" != lift["bundles"][0]]
    with open_store(url) as store:
        clock = time.time_ns() + 5 * NS_PER_S
        folder = survey(tmp_path / "third", lies, -(clock - time.time_ns()) / NS_PER_S, with_lifts=False)
        add_survey(store, read_survey(folder), "ann")
    wait_for(lambda: state_of(local, first["id"]) == "verified")


def wait_for(holds: object, timeout_s: float = 5.0) -> None:
    assert callable(holds)
    end_s = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_a_lift_that_was_made_after_its_confirmation_ended_ends_all_offers(
    local: httpx.Client, url: str, tmp_path: Path
) -> None:
    lift = offered(local)[0]
    assert local.post(f"/api/lifts/{lift['id']}/taken", json={}).status_code == 409
    local.post(f"/api/lifts/{lift['id']}/confirm", json={"map_id": lift["map_id"]}).raise_for_status()
    with open_store(url) as store:
        add_survey(store, read_survey(survey(tmp_path / "third", SECOND[:4], 1.0)), "ann")
    wait_for(lambda: state_of(local, lift["id"]) == "expired" and offered(local))
    for _ in range(2):
        answer = local.post(f"/api/lifts/{lift['id']}/taken", json={})
        assert answer.status_code == 409 and "survey before the next lift" in answer.text
    wait_for(lambda: not offered(local))
    assert [one["code"] for one in local.get("/api/alarms").json()["alarms"]].count("lift-unrecorded") == 1


def test_a_lift_that_failed_after_its_confirmation_ended_ends_all_offers(
    local: httpx.Client, url: str
) -> None:
    first, second = offered(local)[:2]

    def fail(lift: dict[str, object], note: str) -> httpx.Response:
        return local.post(f"/api/lifts/{lift['id']}/end", json={"state": "failed", "note": note})

    def told() -> list[str]:
        alarms = local.get("/api/alarms").json()["alarms"]
        return [str(one["reason"]) for one in alarms if one["code"] == "lift-unrecorded"]

    local.post(f"/api/lifts/{first['id']}/confirm", json={"map_id": first["map_id"]}).raise_for_status()
    with open_store(url) as store:
        for lift in (first, second):
            confirmation.end_lift(store, int(str(lift["id"])), "expired", "ann", "its time is over")
    assert fail(second, "slipped").status_code == 409 and told() == [], "it was never confirmed"
    for _ in range(2):
        answer = fail(first, "slipped")
        assert answer.status_code == 409 and "survey before the next lift" in answer.text
    wait_for(lambda: not offered(local) and len(told()) == 1)
    assert told()[0].startswith(f"lift {first['id']} failed and is expired")


def test_a_failure_that_is_told_twice_raises_no_alarm(local: httpx.Client, url: str) -> None:
    lift = min(offered(local), key=lambda one: one["target"]["x_m"])
    local.post(f"/api/lifts/{lift['id']}/confirm", json={"map_id": lift["map_id"]}).raise_for_status()
    codes = []
    for _ in range(2):
        body = {"state": "failed", "note": "slipped"}
        codes.append(local.post(f"/api/lifts/{lift['id']}/end", json=body).status_code)
    assert codes == [200, 409]
    with open_store(url) as store, store.reading() as connection:
        assert last_raised_ns(connection, "lift-unrecorded") is None
        assert any(one.state == "offered" for one in confirmation.open_lifts(connection))


@pytest.mark.parametrize(("state", "left"), [("expired", 2), ("failed", 1)])
def test_a_lift_that_failed_may_have_moved_what_lies_beside(
    local: httpx.Client, state: str, left: int
) -> None:
    """Bundles lie 1.1 m apart, so that offers of neighbours are within the metre that a lift disturbs."""
    lift = min(offered(local), key=lambda one: one["target"]["x_m"])
    local.post(f"/api/lifts/{lift['id']}/confirm", json={"map_id": lift["map_id"]}).raise_for_status()
    body = {"state": state, "note": "slipped"}
    local.post(f"/api/lifts/{lift['id']}/end", json=body).raise_for_status()
    assert state_of(local, lift["id"]) == state and len(offered(local)) == left


def test_an_older_survey_that_is_added_late_ends_no_offer_of_the_newest(url: str, tmp_path: Path) -> None:
    """A lift between the two is in the newest map already."""
    place = {"x_m": 1.4, "y_m": 0.0, "z_m": 0.2, "yaw_deg": 0.0}
    older = read_survey(survey(tmp_path / "older", FIRST, 1800.0))
    with open_store(url) as store:
        with store.writing() as connection:
            newest = confirmation.newest_survey(connection)
            assert newest is not None
            opened = Entry(connection, "ann", newest.captured_from_ns - 10 * NS_PER_S)
            record = json.dumps({"target": place, "set_down": None})
            lift = opened.add(LIFTS, survey_id=1, rank=1, record=record)
            for state in ("offered", "claimed", "executed"):
                step_lift(opened, lift, state)
            before = confirmation.open_lifts(connection)
        add_survey(store, older, "ann")
        with store.reading() as connection:
            assert len(before) == 3 and len(confirmation.open_lifts(connection)) == 3


def test_a_confirmation_ends_with_its_map(local: httpx.Client, url: str, tmp_path: Path) -> None:
    first, second = offered(local)[:2]
    local.post(f"/api/lifts/{first['id']}/confirm", json={"map_id": first["map_id"]}).raise_for_status()
    with open_store(url) as store:
        add_survey(store, read_survey(survey(tmp_path / "third", SECOND, 1.0)), "ann")
    wait_for(lambda: state_of(local, first["id"]) == "expired")
    answer = local.post(f"/api/lifts/{second['id']}/confirm", json={"map_id": second["map_id"]})
    assert answer.status_code == 409
    new = offered(local)[0]
    assert new["map_id"] != first["map_id"]
    answer = local.post(f"/api/lifts/{new['id']}/confirm", json={"map_id": first["map_id"]})
    assert answer.status_code == 409 and "was offered on map" in answer.json()["problem"]
    assert local.post(f"/api/lifts/{new['id']}/confirm", json={"map_id": new["map_id"]}).status_code == 200


def test_a_confirmation_ends_with_a_veto(local: httpx.Client) -> None:
    lift = offered(local)[0]
    local.post(f"/api/lifts/{lift['id']}/confirm", json={"map_id": lift["map_id"]}).raise_for_status()
    veto = {"code": "disturbed", "reason": "a lorry drove in"}
    assert local.post("/api/vetoes", json=veto | {"code": "x"}).status_code == 422
    local.post("/api/vetoes", json=veto).raise_for_status()
    assert state_of(local, lift["id"]) == "expired" and offered(local) == []
    assert local.get("/api/state").json()["map_vetoes"] == [veto]


def test_a_confirmation_ends_with_its_calibration(
    local: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if a calibration file of the recording, which the samples don't have, were changed."""
    lift = offered(local)[0]
    local.post(f"/api/lifts/{lift['id']}/confirm", json={"map_id": lift["map_id"]}).raise_for_status()
    monkeypatch.setattr("barsight.page.conditions.changed_inputs", lambda _: "recording/cam0.yaml")
    wait_for(lambda: state_of(local, lift["id"]) == "expired")
    alarms = {one["code"]: one for one in local.get("/api/alarms").json()["alarms"]}
    assert alarms["calibration-changed"]["reason"] == "recording/cam0.yaml"


def test_an_offer_ends_with_its_time(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_store(url) as store:
        with store.reading() as connection:
            lift = confirmation.open_lifts(connection)[0]
            clock_ns = confirmation.yard_clock_ns(connection)
        assert 0 < clock_ns - lift.record["valid_from_ns"] < 300 * NS_PER_S
        monkeypatch.setattr(confirmation, "yard_clock_ns", lambda _: lift.record["valid_until_ns"] + NS_PER_S)
        with pytest.raises(InputError, match="expired"):
            confirmation.confirm_lift(store, lift.lift_id, lift.map_id, "ann")
        with store.reading() as connection:
            assert confirmation.open_lifts(connection) == ()
            assert isinstance(verify_chain(connection), AuditChain)


def test_two_operators_confirm_one_lift(local: httpx.Client) -> None:
    lift = offered(local)[0]
    answers: list[int] = []

    def confirm() -> None:
        body = {"map_id": lift["map_id"]}
        answers.append(local.post(f"/api/lifts/{lift['id']}/confirm", json=body).status_code)

    threads = [threading.Thread(target=confirm) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [200, 409, 409, 409]


def test_other_pages_and_names_are_refused(local: httpx.Client) -> None:
    port = local.base_url.port
    assert local.get("/", headers={"Host": f"evil.example:{port}"}).status_code == 403
    assert local.get("/api/state", headers={"Origin": "https://evil.example"}).status_code == 403
    assert local.get("/api/state", headers={"Origin": "null"}).status_code == 403
    assert local.get("/api/state", headers={"Origin": f"http://localhost:{port}"}).status_code == 200
    assert local.get("/api/surveys/a%00/files/result.json").status_code == 403
    lift = offered(local)[0]
    body = {"map_id": lift["map_id"]}
    wrong = {"X-Barsight-Token": "guessed"}
    assert local.post(f"/api/lifts/{lift['id']}/confirm", json=body, headers=wrong).status_code == 403
    with socket.create_connection(("127.0.0.1", port)) as raw:
        head = f"Host: localhost:{port}\r\nContent-Length: 9999999\r\n\r\n"
        raw.sendall(f"POST /api/session HTTP/1.1\r\n{head}".encode())
        assert b" 403 " in raw.recv(100)
    page = local.get("/")
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert b"http://" not in page.content and b"https://" not in page.content
    assert state_of(local, lift["id"]) == "offered"


def test_roles_are_enforced_by_the_api(url: str) -> None:
    tokens = {}
    with open_store(url) as store, entry(store, "ann", "accounts") as opened:
        accounts.add_person(opened, "eve", "engineer", PASSWORD)
        accounts.add_person(opened, "amy", "engineer", PASSWORD)
        for role in MAY:
            tokens[role] = accounts.add_token(opened, f"t-{role}", role)
    with serving(url, ServeOptions(port=0)) as address, httpx.Client(base_url=address) as client:
        assert client.get("/api/state").status_code == 401
        bearer = {role: {"Authorization": f"Bearer {token}"} for role, token in tokens.items()}
        lift = client.get("/api/lifts", headers=bearer["viewer"]).json()["lifts"][0]
        alarm = client.get("/api/alarms", headers=bearer["viewer"]).json()["alarms"][0]
        place = {"lift": lift["id"], "alarm": alarm["id"], "map": lift["map_id"]}
        for role in MAY:
            for method, path, body, right in CHANGES:
                given = None if body is None else json.loads(json.dumps(body).replace("{map}", place["map"]))
                answer = client.request(method, path.format(**place), json=given, headers=bearer[role])
                assert (answer.status_code == 403) == (right not in MAY[role]), (role, path, answer.text)
        assert client.get("/api/state", headers={"Authorization": "Bearer x"}).status_code == 401


def test_people_log_in(url: str) -> None:
    with open_store(url) as store:
        with pytest.raises(ConfigError, match="first account"), entry(store, "ann", "accounts") as opened:
            accounts.add_person(opened, "bob", "operator", PASSWORD)
        with entry(store, "ann", "accounts") as opened:
            accounts.add_person(opened, "eve", "engineer", PASSWORD)
            accounts.add_person(opened, "bob", "operator", PASSWORD)
        with pytest.raises(ConfigError, match="last engineer"), entry(store, "ann", "accounts") as opened:
            accounts.withdraw(opened, "eve")
    with serving(url, ServeOptions(port=0)) as address, httpx.Client(base_url=address) as client:
        told = client.post("/api/session", json={"name": "bob", "password": PASSWORD})
        cookie = told.headers["set-cookie"]
        assert "HttpOnly" in cookie and "SameSite=strict" in cookie
        lift = offered(client)[0]
        path, body = f"/api/lifts/{lift['id']}/confirm", {"map_id": lift["map_id"], "name": "Eve"}
        assert client.post(path, json=body).status_code == 403
        client.headers["X-Barsight-Token"] = told.json()["token"]
        assert client.get("/api/accounts").status_code == 403
        assert client.post(path, json=body).status_code == 200
        steps = client.get("/api/lifts").json()["lifts"]
        assert "bob (operator)" in {step["who"] for one in steps for step in one["steps"]}
        with client.stream("GET", "/api/events") as stream:
            lines = stream.iter_lines()
            assert next(lines) == "event: revision"
            with open_store(url) as store, entry(store, "eve", "accounts") as opened:
                accounts.withdraw(opened, "bob")
            told = [next(lines) for line in lines if line == "event: revision"]
            assert told[-1] == "data: 0", "it ends"
        wait_for(lambda: client.get("/api/state").status_code == 401)
        answers = [
            client.post("/api/session", json={"name": "eve", "password": "wrong"}).status_code
            for _ in range(7)
        ]
        assert answers[:5] == [401] * 5 and 429 in answers[5:]
    content = Path(url.removeprefix("sqlite:///")).read_bytes()
    assert PASSWORD.encode() not in content


def test_failed_log_ins_wait_longer_and_longer() -> None:
    now = [0.0]
    throttle = Throttle(lambda: now[0])
    waits = []
    for _ in range(20):
        throttle.fail("name eve")
        try:
            throttle.expect_free("name eve", "client a")
            waits.append(0.0)
        except AccessError as error:
            waits.append(error.wait_s)
            now[0] += error.wait_s
    assert waits[:7] == [0, 0, 0, 0, 1, 2, 4] and max(waits) == 300.0
    throttle.expect_free("name bob")


def test_a_log_in_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    known = {"eve": accounts.Account("eve", "person", "engineer", "s")}
    monkeypatch.setattr("barsight.page.access.is_password", lambda account, _: account is not None)
    access = Access(lambda: known, lambda: now[0])
    cookie, _ = access.log_in("eve", PASSWORD, "a")
    assert access.caller(f"barsight_session={cookie}", "").name == "eve"
    now[0] += 2.5 * 3600
    with pytest.raises(AccessError, match="ended"):
        access.caller(f"barsight_session={cookie}", "")
    cookie, _ = access.log_in("eve", PASSWORD, "a")
    now[0] += 1.5 * 3600
    assert access.caller(f"barsight_session={cookie}", "", is_request=False).name == "eve"
    now[0] += 3600
    with pytest.raises(AccessError, match="ended"):
        access.caller(f"barsight_session={cookie}", "", is_request=False)
    cookie, _ = access.log_in("eve", PASSWORD, "a")
    known["eve"] = accounts.Account("eve", "person", "viewer", "another")
    with pytest.raises(AccessError, match="log in"):
        access.caller(f"barsight_session={cookie}", "")


def test_files_of_a_survey_are_held_against_their_digests(local: httpx.Client, made: Path) -> None:
    one = local.get("/api/surveys").json()["surveys"][0]
    base = f"/api/surveys/{one['map_id']}/files"
    report = local.get(f"{base}/report.html")
    assert report.status_code == 200 and report.headers["content-security-policy"].startswith("sandbox")
    assert local.get(f"{base}/height.tif").content == (made / "second" / "height.tif").read_bytes()
    for name in ("..%2f..%2fyard.db", "yard.db", "%2fetc%2fpasswd"):
        assert local.get(f"{base}/{name}").status_code in (404, 409)
    path = made / "second" / "bundles.json"
    whole = path.read_bytes()
    path.write_bytes(whole + b" ")
    assert local.get(f"{base}/bundles.json").status_code == 409
    path.write_bytes(whole)
    assert local.get(f"{base}/bundles.json").status_code == 200


def test_a_share_with_the_folders_that_is_away_ends_no_watch(
    local: httpx.Client, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(path: Path) -> bool:
        raise OSError(errno.ESTALE, "Stale file handle", str(path))

    with open_store(url) as store:
        monkeypatch.setattr(Path, "is_file", away)
        wait_for(lambda: "survey-files" in local.get("/api/alarms").text)
        with entry(store, "ann", "alarm") as opened:
            raise_alarm(opened, "rig", "loose")
        wait_for(lambda: "loose" in local.get("/api/alarms").text)


def test_the_header_shows_the_alarm_of_the_first_priority(local: httpx.Client) -> None:
    for code in ("bundle-moved", "calibration-changed", "survey-files"):
        assert local.post("/api/alarms", json={"code": code, "reason": "told by hand"}).status_code == 200
    alarms = local.get("/api/alarms").json()["alarms"]
    assert [one["priority"] for one in alarms] == [1, 2, 3, 3]
    assert local.get("/api/state").json()["top_alarm"]["code"] == "calibration-changed"


def test_what_stands_open_is_listed_however_much_came_since(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("barsight.page.documents.MAX_ALARMS", 2)
    monkeypatch.setattr("barsight.page.documents.MAX_LIFTS", 1)
    with open_store(url) as store:
        with entry(store, "ann", "alarms") as opened:
            numbers = [raise_alarm(opened, "rig", f"{k}") for k in range(5)]
            for number in numbers[1:]:
                step_alarm(opened, number, "cleared")
        with store.reading() as connection:
            alarms, lifts = alarm_records(connection), lift_records(connection)
            begun = [lift.lift_id for lift in confirmation.open_lifts(connection)]
    assert [one["id"] for one in alarms] == [numbers[0], numbers[4], numbers[3]]
    assert len(begun) > 1 and {one["id"] for one in lifts} == set(begun)


def test_the_crane_s_readings_are_told_beside_the_target(url: str) -> None:
    with open_store(url) as store, store.reading() as connection:
        records = {lift.lift_id: lift.record for lift in confirmation.open_lifts(connection)}
        told = {one["id"]: one for one in lift_records(connection)}
    assert records
    for number, record in records.items():
        for name in ("crane_target", "crane_set_down"):
            assert told[number][name] == record[name]


@pytest.mark.parametrize(
    ("bundles", "age_s", "told"),
    [((4,), 600.0, False), ((4, 5), 600.0, False), ((4,), 7200.0, True), ((5,), 600.0, True)],
)
def test_a_bundle_is_gone_without_a_lift_unless_one_took_it_since_it_was_seen(
    url: str, bundles: tuple[int, ...], age_s: float, told: bool
) -> None:
    with open_store(url) as store, store.writing() as connection:
        newest = confirmation.newest_survey(connection)
        assert newest is not None
        opened = Entry(connection, "ann", newest.captured_to_ns - round(age_s * NS_PER_S))
        lift = opened.add(LIFTS, survey_id=1, rank=1, record='{"set_down": null}')
        for number in bundles:
            opened.add(LIFT_BUNDLES, lift_id=lift, bundle_id=number)
        for state in ("offered", "claimed", "executed"):
            step_lift(opened, lift, state)
        assert (("bundle-gone", "B4") in find_conditions(connection, None)) is told


def test_an_alarm_goes_through_its_states(local: httpx.Client, made: Path, tmp_path: Path) -> None:
    def alarms() -> dict[str, dict[str, object]]:
        return {one["code"]: one for one in local.get("/api/alarms").json()["alarms"]}

    gone = alarms()["bundle-gone"]
    local.post(f"/api/alarms/{gone['id']}/acknowledge", json={"note": "seen"}).raise_for_status()
    assert alarms()["bundle-gone"]["state"] == "acknowledged"
    kept = made / "second" / "lifts.json"
    kept.rename(tmp_path / "away")
    wait_for(lambda: alarms().get("survey-files", {}).get("state") == "raised")
    (tmp_path / "away").rename(kept)
    wait_for(lambda: alarms()["survey-files"]["state"] == "returned")
    number = alarms()["survey-files"]["id"]
    local.post(f"/api/alarms/{number}/acknowledge", json={"note": ""}).raise_for_status()
    assert alarms()["survey-files"]["state"] == "cleared"


def test_places_are_shown_by_the_newest_survey_that_saw_them(url: str, tmp_path: Path) -> None:
    """The second survey's map ends at x = 7.3 m, the first one's before it: only the second one shows."""
    with open_store(url) as store:
        with store.reading() as connection:
            layers = find_layers(connection)
        assert [one.folder.name for one in layers] == ["second"]
        add_survey(store, read_survey(survey(tmp_path / "third", FIRST[:2], 1.0, with_lifts=False)), "ann")
        with store.reading() as connection:
            before, after = find_layers(connection)
    assert (before.folder.name, after.folder.name) == ("second", "third")
    columns = before.heights.x_m
    assert not before.shown[:, columns < 2.8].any() and before.shown[:, columns > 3.1].any()
    assert paint_layer(before, "photo") != paint_layer(before, "height")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--host", "0.0.0.0"], "--public-url"),
        (["--host", "0.0.0.0", "--public-url", "http://yard"], "is not https"),
        (["--host", "0.0.0.0", "--public-url", "https://yard"], "unencrypted"),
        (["--public-url", "https://yard"], "no accounts"),
        (["--certificate", "no.pem"], "go together"),
        (["--port", "99999"], "does not exist"),
    ],
)
def test_it_does_not_stand_open(
    made: Path, arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["serve", "--store", f"sqlite:///{made / 'yard.db'}", *arguments]) in (2, 3, 4)
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1


def test_a_live_folder_that_is_not_there_is_told(
    url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file; name the folder that barsight live writes"):
        ServeOptions(live=tmp_path / "file")
    ended = SimpleNamespace(Event=lambda: SimpleNamespace(wait=lambda: None))
    monkeypatch.setattr("barsight.page.api.serve.serving", lambda *_: contextlib.nullcontext("http://here"))
    monkeypatch.setattr("barsight.page.api.serve.threading", ended)
    serve(url, ServeOptions(live=tmp_path / "later"))
    assert "later: not there yet" in capsys.readouterr().err


def test_the_usual_port_may_be_left_out() -> None:
    """Browsers leave it out of Host and Origin, whether or not it stands in the address."""
    hosts, origins = ServeOptions(public_url="https://Yard.example:443").names(8000)
    assert {"yard.example", "127.0.0.1:8000"} <= hosts and "127.0.0.1" not in hosts
    assert "https://yard.example" in origins
    hosts, origins = ServeOptions().names(80)
    assert "localhost" in hosts and "http://localhost" in origins and "https://localhost" not in origins


def test_a_taken_port_is_one_line(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert run(["serve", "--store", f"sqlite:///{made / 'yard.db'}", "--port", port]) == 4
    said = capsys.readouterr().err
    assert "is taken" in said and said.count("\n") == 1


def test_slow_readers_skip(local: httpx.Client) -> None:
    with local.stream("GET", "/api/events") as stream:
        lines = stream.iter_lines()
        revisions = (int(next(lines)[4:]) for line in lines if line == "event: revision")
        first = next(revisions)
        for k in range(20):
            body = {"code": f"rig-{k}", "reason": "loose"}
            local.post("/api/alarms", json=body).raise_for_status()
        newest = local.get("/api/state").json()["revision"]
        got = []
        for revision in revisions:
            got.append(revision)
            if revision == newest:
                break
    assert newest == first + 20 and got == sorted(set(got))


def test_the_map_at_a_place_is_as_old_as_the_survey_that_saw_it(url: str) -> None:
    with open_store(url) as store, store.reading() as connection:
        layers = find_layers(connection)
        times = {one.map_id: one.captured_to_ns for one in list_surveys(connection)}
    assert newest_at(layers, (2.0, 0.0)) == max(times.values())
    assert newest_at(layers, (200.0, 0.0)) is None
    hidden = replace(layers[-1], shown=np.zeros_like(layers[-1].shown))
    older = replace(layers[-1], seen_ns=min(times.values()))
    assert newest_at((older, hidden), (2.0, 0.0)) == min(times.values())


def test_the_stock_list_that_is_written_agrees_with_the_yard(
    local: httpx.Client, url: str, tmp_path: Path
) -> None:
    answer = local.get("/api/stock.csv")
    assert answer.status_code == 200 and "attachment" in answer.headers["content-disposition"]
    path = tmp_path / "stock.csv"
    path.write_text(answer.text, encoding="utf-8")
    listed = read_stock(path)
    with open_store(url) as store, store.reading() as connection:
        present = present_yard(connection)
    assert [one.name for one in listed][:3] == ["A1", "A2", "A3"] and len(listed) == len(present)
    bundles = tuple(replace(one.sighting.bundle, id=k) for k, one in enumerate(present))
    match = match_stock(listed, bundles)
    assert (match.moved, match.missing, match.hidden, match.extra) == ((), (), (), ())
    assert len(match.matched) == len(present) and not any(one.disagrees for one in match.matched)
    assert {one.name: present[one.bundle].sighting.identity for one in match.matched} == {
        one.name: each.sighting.identity for one, each in zip(listed, present, strict=True)
    }
    assert run(["yard", url, "--stock-list", str(tmp_path / "again.csv")]) == 0
    assert (tmp_path / "again.csv").read_text() == answer.text
    assert sum(one.length_m is None for one in listed) == 1  # its end is open


def test_calibrations_and_recordings_are_told_and_an_engineer_approves(local: httpx.Client, url: str) -> None:
    told = local.get("/api/equipment").json()
    (calibration,) = told["calibrations"]
    assert (calibration["rig"], calibration["crane"], calibration["times"]) == ("1", "1", [])
    assert {one["state"] for one in told["recordings"]} == {"measured"}
    digest = calibration["digest"]
    assert local.post("/api/calibrations", json={"digest": "f00d"}).status_code == 422
    assert local.post("/api/calibrations", json={"digest": digest, "until_ns": 5}).status_code == 422
    assert local.post("/api/calibrations", json={"digest": digest, "note": "No. 7"}).status_code == 200
    (time_,) = local.get("/api/equipment").json()["calibrations"][0]["times"]
    assert time_["approved_by"] == "local (engineer)" and time_["note"] == "No. 7"
    assert offered(local) != []
    with open_store(url) as store, entry(store, "ann", "approved") as opened:
        note_calibration(opened, "beef", "1")
        approve_calibration(opened, "beef", time_["from_ns"] + 1, None)
    local.post("/api/calibrations", json={"digest": "beef"})
    assert offered(local) == []
    state = local.get("/api/state").json()
    assert [one["code"] for one in state["map_vetoes"]] == ["calibration-changed"]
    assert state["top_alarm"]["code"] == "calibration-changed"


def test_the_model_is_read_by_those_who_may_read(local: httpx.Client, url: str) -> None:
    survey = local.get("/api/state").json()["survey"]["map_id"]
    answer = local.get(f"/api/surveys/{survey}/model")
    length = int.from_bytes(answer.content[:4], "little")
    head = json.loads(answer.content[4 : 4 + length])
    segments = sum(count for _, count in head["lines"])
    assert len(answer.content) == 4 + length + 15 * head["points"] + 24 * segments
    places = np.frombuffer(answer.content, "<f4", 3 * head["points"], 4 + length).reshape(-1, 3)
    assert head["points"] > 1000 and -2.0 < places[:, 0].min() < places[:, 0].max() < 8.0
    assert local.get(f"/api/surveys/{survey}/model?by=smell").status_code == 404
    assert local.get("/api/surveys/0000/model").status_code == 404
    with open_store(url) as store, entry(store, "ann", "account") as opened:
        accounts.add_person(opened, "ann", "engineer", PASSWORD)
    time.sleep(0.5)
    assert local.get(f"/api/surveys/{survey}/model").status_code == 401
