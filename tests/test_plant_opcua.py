"""The OPC UA server against node-opcua's client, and against the specification's own table of transitions."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from opcua_servers import PASSWORD, node_package, opcua_plant, walk, write_identity

pytestmark = pytest.mark.slow  # each server takes some ten seconds to start

pytest.importorskip("asyncua")

MOVED = {"Good": True, "BadInvalidState": False}


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("result")
    for name in ("bundles.json", "lifts.json"):
        (folder / name).write_text(json.dumps({"is_simulated": True, name[:-5]: [1, 2]}))
    (folder / "height.tif").write_bytes(bytes(range(256)) * 1000)
    return folder


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory, result: Path) -> dict[str, Any]:
    nodesets = node_package("node-opcua-nodesets") / "nodesets"
    node_package("node-opcua-client")
    folder = tmp_path_factory.mktemp("opcua")
    who = {name: write_identity(folder, name) for name in ("trusted", "stranger")}
    who["expired"] = write_identity(folder, "expired", -0.02)
    with opcua_plant(folder, nodesets=str(nodesets)) as plant:
        plant.trust(who["trusted"])
        plant.trust(who["expired"])
        seen = walk(plant, folder, result=str(result), **who)
        seen["log"] = plant.log
    return seen


def test_the_state_is_read_and_nothing_is_said_where_nothing_is_known(report: dict[str, Any]) -> None:
    state = report["state"]
    assert state["mode"] == ["Good", "surveyed"]
    assert state["position_m"] == ["Good", [1, 2, 3]]
    assert state["lift.x_m"] == ["Good", 12.5]
    assert state["lift.mass_kg"] == ["BadNoData", None]
    assert {status for status, _ in report["quiet"].values()} == {"BadNoCommunication"}
    assert report["write"] == "BadUserAccessDenied"
    assert "Traceback" not in report["log"]


def test_transitions_are_those_of_the_specification(report: dict[str, Any]) -> None:
    """Each method in each state: allowed where the NodeSet names it as a cause, and it leads there."""
    targets: dict[tuple[str, str], set[str]] = {}
    for row in report["table"]:
        for cause in row["causes"]:
            targets.setdefault((row["from"][0], cause), set()).add(row["to"][0])
    assert len(report["transitions"]) == 6 * 9
    for seen in report["transitions"]:
        before, after, start = seen["before"], seen["after"], seen["start"]
        assert start in (before["main"], before["automatic"])
        wanted = set()
        for state in (before["main"], before["automatic"]):
            wanted |= targets.get((state, seen["method"]), set())
        assert MOVED[seen["status"]] == bool(wanted), seen
        if wanted:
            assert {after["main"], after["automatic"]} & wanted, seen
        else:
            assert after == before


def test_the_states_carry_their_ids_and_numbers(report: dict[str, Any]) -> None:
    seen = {
        (s["after"]["main"], s["after"]["ids"][0], s["after"]["numbers"][0]) for s in report["transitions"]
    }
    assert {(name, int(number)) for name, _, number in seen} == {
        ("Preoperational", 1), ("Halted", 2), ("Operational", 4)
    }  # fmt: skip
    assert {node.split(";")[1] for _, node, _ in seen} == {"i=5028", "i=5029", "i=5031"}


def test_viewers_change_nothing(report: dict[str, Any]) -> None:
    assert set(report["viewer"].values()) == {"BadUserAccessDenied"}
    assert report["handshake"]["viewer"] == ["BadUserAccessDenied", []]


def test_the_handshake_is_taken_from_its_role_only(report: dict[str, Any]) -> None:
    told = report["handshake"]
    assert told["taken"] == ["Good", ["token of engineer", True, ""]]
    assert told["unknown"] == ["Good", ["", False, "no such lift"]]
    assert (told["wrong"][0], told["none"][0]) == ("BadInvalidArgument", "BadArgumentsMissing")


def test_a_job_ends_in_a_result_with_its_file(report: dict[str, Any], result: Path) -> None:
    job = report["job"]
    assert job["started"][0] == job["get"] == job["closed"] == "Good"
    assert job["job"] == job["started"][1]
    assert job["simulated"] is True
    documents = [json.loads((result / name).read_text()) for name in ("bundles.json", "lifts.json")]
    assert [json.loads(one) for one in job["content"]] == documents
    assert [json.loads(one) for one in job["ready"]["ResultContent"]] == documents
    assert job["sha256"] == hashlib.sha256((result / "height.tif").read_bytes()).hexdigest()
    assert job["after"]["automatic"] == "Ready"
    kinds = [event["EventType"].split("i=")[1] for event in job["events"]]
    assert kinds == ["1018", "1013", "1025", "1024", "1018", "1023"]
    assert [event["Transition.Number"] for event in job["events"] if event["FromState"]] == [671, 760]


def test_alarms_are_acknowledged_once_and_end(report: dict[str, Any]) -> None:
    alarm = report["alarm"]
    raised, acked, gone = alarm["raised"], alarm["acked"], alarm["gone"]
    states = [(one["ActiveState.Id"], one["AckedState.Id"], one["Retain"]) for one in (raised, acked, gone)]
    assert states == [(True, False, True), (True, True, True), (False, True, False)]
    assert (acked["Comment"]["text"], acked["ClientUserId"]) == ("seen", "engineer")
    assert alarm["statuses"] == [
        "BadUserAccessDenied", "BadEventIdUnknown", "Good", "BadConditionBranchAlreadyAcked"
    ]  # fmt: skip
    assert alarm["refreshed"]
    assert (alarm["inError"]["main"], alarm["after"]["main"]) == ("Error", "Preoperational")
    kinds = {event["EventType"].split("i=")[1] for event in alarm["events"]}
    assert {"1035", "1018", "1019", "1020"} <= kinds


def test_strangers_stay_out(report: dict[str, Any]) -> None:
    told = report["strangers"]
    assert "BadCertificateUntrusted" in told["untrusted"]
    assert "BadCertificateTimeInvalid" in told["expired"]
    assert "BadSecurity" in told["unsecured"]
    assert "BadUserAccessDenied" in told["password"]
    assert "BadUserAccessDenied" in told["unknown"]


def test_users_are_kept_by_digest(tmp_path: Path) -> None:
    from barsight.core.errors import ConfigError, InputError
    from barsight.plant.opcua.security.access import PasswordUsers, add_user, read_users

    path = tmp_path / "users.json"
    add_user(path, "crane", "operator", PASSWORD)
    assert PASSWORD not in path.read_text()
    users = PasswordUsers(read_users(path), allow_anonymous=False)
    found = users.get_user(None, "crane", PASSWORD)
    assert found is not None
    assert found.plant_role == "operator"
    assert users.get_user(None, "crane", PASSWORD + " ") is None
    assert users.get_user(None) is None
    with pytest.raises(ConfigError, match="at least 10"):
        add_user(path, "crane", "operator", "short")
    path.write_text('{"crane": {"role": "king", "salt": "00", "digest": "00"}}')
    with pytest.raises(InputError, match="not a list of users"):
        read_users(path)
