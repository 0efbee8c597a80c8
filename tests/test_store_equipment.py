"""Calibrations with validity, and recordings: what the store keeps of them, and what it forbids."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import select

from barsight.cli.main import run
from barsight.core.errors import ConfigError, InputError
from barsight.core.stamps import NS_PER_S
from barsight.recording.writers.retention import PROTECTED
from barsight.store import confirmation
from barsight.store.adding import add_survey, read_survey
from barsight.store.audit import AuditChain, entry, verify_chain
from barsight.store.calibrations import (
    approve_calibration,
    find_calibration,
    list_calibrations,
    note_calibration,
    why_invalid,
)
from barsight.store.confirmation import confirm_lift, expire_stale, map_vetoes, newest_survey, open_lifts
from barsight.store.history import parse_time
from barsight.store.opening import Store, open_store
from barsight.store.recordings import list_recordings
from barsight.store.tables import LIFT_STATES
from barsight.yard.events import YardEvent, write_events
from page_yards import SECOND, survey
from result_folders import summary
from yard_folders import lifts, write_folder

EVENTS = "events.csv"
PASS = ("magnet", 9.0, 9.0, 0.0, 1.0, 1.0)

DAY_NS = 86400 * NS_PER_S


def approve(store: Store, digest: str, from_ns: int, until_ns: int | None = None, rig: str = "east") -> None:
    with entry(store, "ann", "approved") as opened:
        note_calibration(opened, digest, rig)
        approve_calibration(opened, digest, from_ns, until_ns)


def test_a_newer_calibration_ends_the_older(store: Store) -> None:
    approve(store, "aaaa", 10 * DAY_NS)
    approve(store, "bbbb", 20 * DAY_NS, 30 * DAY_NS)
    with entry(store, "bob", "known") as opened:
        note_calibration(opened, "cccc", "west", "north crane")
    with store.reading() as connection:
        assert why_invalid(connection, "aaaa", 15 * DAY_NS) == ""
        assert why_invalid(connection, "bbbb", 15 * DAY_NS).endswith(
            "is valid from 1970-01-21T00:00:00Z on only"
        )
        assert "until 1970-01-21T00:00:00Z, when bbbb took" in why_invalid(connection, "aaaa", 20 * DAY_NS)
        assert why_invalid(connection, "bbbb", 30 * DAY_NS - 1) == ""
        assert "was valid until 1970-01-31" in why_invalid(connection, "bbbb", 30 * DAY_NS)
        assert why_invalid(connection, "cccc", 15 * DAY_NS) == ""  # of a rig of which none was approved
        assert "never approved" in why_invalid(connection, "dddd", 15 * DAY_NS)  # nobody knows whose
        known = list_calibrations(connection)
        assert [(one.digest, one.rig, one.crane, len(one.times)) for one in known] == [
            ("aaaa", "east", "1", 1), ("bbbb", "east", "1", 1), ("cccc", "west", "north crane", 0),
        ]  # fmt: skip
        ends = [(one.times[0].from_ns, one.times[0].until_ns) for one in known[:2]]
        assert ends == [(10 * DAY_NS, 20 * DAY_NS), (20 * DAY_NS, 30 * DAY_NS)]
        assert {one.approved_by for each in known for one in each.times} == {"ann"}
        assert find_calibration(connection, "a") == "aaaa"
        with pytest.raises(
            ConfigError, match=r"^x: is neither a file nor a known calibration; known are aaaa, bbbb, cccc"
        ):
            find_calibration(connection, "x")
    approve(store, "aaaa", 25 * DAY_NS)
    with store.reading() as connection:
        assert why_invalid(connection, "aaaa", 40 * DAY_NS) == ""
        assert "when aaaa took its place" in why_invalid(connection, "bbbb", 26 * DAY_NS)
        assert isinstance(verify_chain(connection), AuditChain)
    with pytest.raises(InputError, match="is of rig east, not west"):
        approve(store, "aaaa", 0, rig="west")
    with pytest.raises(ConfigError, match="that is no time"):
        approve(store, "aaaa", DAY_NS, DAY_NS)


def test_lifts_of_a_calibration_that_is_not_valid_are_not_offered(store: Store, tmp_path: Path) -> None:
    add_survey(store, read_survey(survey(tmp_path / "first", SECOND, 60.0)), "ann")
    with store.reading() as connection:
        newest = newest_survey(connection)
        offers = open_lifts(connection)
    assert newest is not None and len(offers) == 3
    approve(store, "beef", 0, rig="1")
    with pytest.raises(InputError, match="is expired"):
        confirm_lift(store, offers[0].lift_id, newest.map_id, "ann")
    with store.reading() as connection:
        assert open_lifts(connection) == ()
        ended = select(LIFT_STATES.c.note).where(LIFT_STATES.c.state == "expired")
        told = f"expired: calibration-changed: calibration {newest.calibration_id} was never approved"
        assert set(connection.execute(ended).scalars()) == {told}
    add_survey(store, read_survey(survey(tmp_path / "second", SECOND, 1.0)), "ann")
    with store.reading() as connection:
        newest = newest_survey(connection)
        assert newest is not None and open_lifts(connection) == ()
        assert [veto["code"] for veto in map_vetoes(connection, newest.id)] == ["calibration-changed"]
    approve(store, newest.calibration_id, 0, rig="1")
    add_survey(store, read_survey(survey(tmp_path / "third", SECOND, 0.0)), "ann")
    assert expire_stale(store, "ann") == 0
    with store.reading() as connection:
        assert len(open_lifts(connection)) == 3


def test_lifts_that_look_back_or_are_ahead_of_the_clock_are_not_offered(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second yard's, after this computer's clock was set an hour back."""
    real = summary() | {"is_simulated": False}
    monkeypatch.setattr("page_yards.summary", lambda: real)
    folder = survey(tmp_path / "back", SECOND, 1.0, with_lifts=False)
    assert lifts(folder, "--at", "end") == 0
    assert json.loads((folder / "lifts.json").read_text())["lifts"]
    add_survey(store, read_survey(folder), "ann")
    with store.reading() as connection:
        newest = newest_survey(connection)
        assert newest is not None and open_lifts(connection) == ()
        assert [veto["code"] for veto in map_vetoes(connection, newest.id)] == ["map-too-old"]
    with open_store(f"sqlite:///{tmp_path / 'back.db'}", create=True) as other:
        add_survey(other, read_survey(survey(tmp_path / "now", SECOND, 1.0)), "ann")
        with other.reading() as connection:
            offers = len(open_lifts(connection))
        assert offers == 3 and expire_stale(other, "ann") == 0
        back_ns = time.time_ns() - 3600 * NS_PER_S
        monkeypatch.setattr(confirmation, "yard_clock_ns", lambda _: back_ns)
        assert expire_stale(other, "ann") == offers


@pytest.mark.parametrize(
    ("change", "ended"),
    [
        (lambda folder: lifts(folder, "--lifted", "0"), 3),
        (
            lambda folder: write_events(
                [YardEvent(time.time_ns(), "magnet", 9, 9, 0, 1, 1)], folder / EVENTS
            ),
            3,
        ),
        (lambda folder: (folder / EVENTS).write_text("torn"), 3),
        (shutil.rmtree, 0),
    ],
)
def test_what_is_told_in_a_survey_s_folder_ends_the_stored_offers(
    store: Store, tmp_path: Path, change: Callable[[Path], object], ended: int
) -> None:
    folder = survey(tmp_path / "one", SECOND, 1.0)
    add_survey(store, read_survey(folder), "ann")
    assert expire_stale(store, "ann") == 0
    change(folder)
    assert expire_stale(store, "ann") == ended
    add_survey(store, read_survey(survey(tmp_path / "two", SECOND, 0.0)), "ann")
    assert expire_stale(store, "ann") == 0
    with store.reading() as connection:
        assert len(open_lifts(connection)) == 3


def test_a_recording_is_kept_with_its_reason(
    store_url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    recording = tmp_path / "recording"
    recording.mkdir()
    told = {"path": str(recording), "format": "euroc"}
    folder = write_folder(tmp_path / "out", recording=told)
    with open_store(store_url, create=True) as store:
        add_survey(store, read_survey(folder), "ann", rig="east", crane="north")
        with store.reading() as connection:
            (one,) = list_recordings(connection)
    assert (one.key, one.rig, one.state, one.who) == (str(recording), "east", "measured", "ann")
    assert len(one.digest) == 64 and len(one.surveys) == 1
    assert run(["store", "keep", store_url, one.digest[:8], "the bundle that slipped", "--by", "bob"]) == 0
    assert (recording / PROTECTED).read_text() == "the bundle that slipped\n"
    assert run(["store", "list", store_url]) == 0
    said = capsys.readouterr().out
    assert "kept" in said and "slipped" in said and "never approved" in said and "north" in said
    assert "…" not in said and one.surveys[0] in said
    monkeypatch.chdir(tmp_path)
    assert run(["store", "keep", store_url, "recording", "again"]) == 2
    assert f"{recording}: is kept already" in capsys.readouterr().err
    assert run(["store", "keep", store_url, "recording", "looked at", "--release"]) == 0
    assert not (recording / PROTECTED).exists()
    assert run(["store", "keep", store_url, "recording", "looked at", "--release"]) == 2
    assert f"{recording}: isn't kept" in capsys.readouterr().err
    assert run(["store", "keep", store_url, "nowhere", "why"]) == 2
    assert "is no recording that the store knows" in capsys.readouterr().err
    (recording / PROTECTED).write_text("an accident\n")
    with open_store(store_url) as store:
        add_survey(store, read_survey(write_folder(tmp_path / "again", shift_m=0.01, recording=told)), "ann")
        with store.reading() as connection:
            (one,) = list_recordings(connection)
            assert isinstance(verify_chain(connection), AuditChain)
    assert (one.state, one.note, len(one.surveys), one.rig) == ("kept", "an accident", 2, "east")


def test_a_calibration_is_approved_at_the_terminal(
    store_url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "out")
    assert lifts(folder) == 0
    assert run(["store", "add", store_url, str(folder), "--rig", "east"]) == 0
    given = ["store", "approve", store_url, "ca1b", "--by", "ann", "--note", "certificate 7"]
    assert run([*given, "--valid-from", "2020-01-01T00:00:00Z", "--valid-until", "2021-01-01T00:00:00Z"]) == 0
    assert "of rig east is approved by ann, from 2020-01-01" in capsys.readouterr().out
    assert run(["store", "list", store_url, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    (time,) = content["calibrations"][0]["times"]
    assert time["until_ns"] == parse_time("2021-01-01T00:00:00Z") and time["note"] == "certificate 7"
    assert content["recordings"][0]["state"] == "measured"
    assert run(["store", "approve", store_url, "f00d"]) == 2
    assert "is neither a file nor a known calibration" in capsys.readouterr().err
