"""The store itself, on SQLite and PostgreSQL: audit chain, rows only added, writers, kills, migrations."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import psycopg
import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import event, func, select, text
from sqlalchemy.exc import DBAPIError

import barsight.store.opening as opening
from barsight.cli.main import run
from barsight.core.errors import ConfigError, Failed, InputError, OutputError
from barsight.page.documents import survey_records
from barsight.store.adding import AddedSurvey, add_survey, read_survey
from barsight.store.audit import AuditChain, entry, verify_chain
from barsight.store.calibrations import approve_calibration, note_calibration
from barsight.store.confirmation import newest_survey
from barsight.store.history import (
    BundleSighting,
    PresentBundle,
    list_surveys,
    newest_absences,
    newest_sightings,
    next_sightings,
    parse_time,
)
from barsight.store.opening import Store, open_store
from barsight.store.states import LIFT_STEPS, alarm_state, raise_alarm, step_alarm, step_lift
from barsight.store.stock import listed_bundles
from barsight.store.tables import (
    ABSENCES,
    ALARMS,
    AUDIT,
    BUNDLES,
    LIFTS,
    METADATA,
    SIGHTINGS,
    SURVEY_VETOES,
    SURVEYS,
)
from lift_yards import laid, record
from store_servers import add_database
from store_yards import CraneYard
from yard_folders import lifts, write_folder


def alarm(store: Store, reason: str = "the rig drifted") -> int:
    with entry(store, "ann", "alarm") as opened:
        return raise_alarm(opened, "rig-drift", reason)


def checked(store: Store) -> AuditChain | Failed:
    with store.reading() as connection:
        return verify_chain(connection)


def tamper(store: Store, statement: str) -> None:
    """Change a row as someone with the database's own tools would."""
    with store.writing() as connection:
        if store.engine.dialect.name == "sqlite":
            for name in METADATA.tables:
                for act in ("update", "delete"):
                    connection.execute(text(f"DROP TRIGGER IF EXISTS {name}_no_{act}"))
        else:
            connection.execute(text("SET session_replication_role = replica"))
        connection.execute(text(statement))


@pytest.mark.parametrize(
    ("statement", "says"),
    [
        ("UPDATE audit SET who = 'eve' WHERE id = 2", "audit row 2 does not hold: it was changed"),
        ("UPDATE audit SET at_ns = at_ns + 1 WHERE id = 3", "audit row 3"),
        ("DELETE FROM audit WHERE id = 2", "audit row 2 does not hold: it is missing"),
        ("UPDATE alarms SET reason = 'none' WHERE id = 2", "audit row 2 does not hold: what it added"),
        ("DELETE FROM alarm_states WHERE alarm_id = 3", "audit row 3"),
        ("DELETE FROM audit WHERE id = 3", "table alarms has 3 rows, the audit log covers 2"),
    ],
)
def test_the_first_row_that_does_not_hold_is_named(store: Store, statement: str, says: str) -> None:
    for _ in range(3):
        alarm(store)
    chain = checked(store)
    assert isinstance(chain, AuditChain) and chain.entries == 3
    tamper(store, statement)
    failed = checked(store)
    assert isinstance(failed, Failed) and says in failed.reason


@pytest.mark.parametrize("statement", ["UPDATE alarms SET code = 'x'", "DELETE FROM alarm_states"])
def test_rows_are_only_added(store: Store, statement: str) -> None:
    alarm(store)
    with pytest.raises(DBAPIError, match="only adds rows"), store.writing() as connection:
        connection.execute(text(statement))
    assert isinstance(checked(store), AuditChain)


def test_states_follow_only_as_they_may(store: Store) -> None:
    number = alarm(store)
    with entry(store, "bob", "alarm") as opened:
        step_alarm(opened, number, "acknowledged")
        step_alarm(opened, number, "cleared")
    refused = pytest.raises(InputError, match="is cleared: acknowledged can't follow")
    with refused, entry(store, "bob", "alarm") as opened:
        step_alarm(opened, number, "acknowledged")
    with store.reading() as connection:
        assert alarm_state(connection, number) == "cleared"
    with pytest.raises(InputError, match="is None"), entry(store, "bob", "lift") as opened:
        step_lift(opened, 7, "claimed")
    assert {state for after in LIFT_STEPS.values() for state in after} == {
        "offered", "claimed", "executing", "executed", "failed", "verified", "expired",
    }  # fmt: skip


def test_the_migrations_make_the_tables_of_the_code(store: Store) -> None:
    with store.reading() as connection:
        assert compare_metadata(MigrationContext.configure(connection), METADATA) == []


def test_a_map_is_added_once_and_a_changed_file_refused(store: Store, tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "out")
    assert lifts(folder) == 0
    assert add_survey(store, read_survey(folder), "ann").counts == {"found": 2}
    again = add_survey(store, read_survey(folder), "ann")
    assert not again.is_new
    chain = checked(store)
    assert isinstance(chain, AuditChain) and chain.entries == 1
    with store.reading() as connection:
        offered = connection.execute(text("SELECT COUNT(*) FROM lift_states WHERE state = 'offered'"))
        assert offered.scalar() == 2
    for name, old, new in (("bundles.json", '"bars": 7', '"bars": 5'), ("height.tif", "", "")):
        other = write_folder(tmp_path / name, shift_m=0.01)
        content = (other / name).read_bytes()
        (other / name).write_bytes(content.replace(old.encode(), new.encode(), 1) if old else content[:-1])
        with pytest.raises(InputError, match=name):
            add_survey(store, read_survey(other), "ann")
    real = write_folder(tmp_path / "real", is_simulated=False)
    with pytest.raises(InputError, match="was measured, the store holds simulated"):
        add_survey(store, read_survey(real), "ann")
    assert checked(store) == chain


def together(*calls: Callable[[], object]) -> list[object]:
    """Run in threads at once; each has connections of its own."""
    results: list[object] = [None] * len(calls)

    def keep(k: int) -> None:
        results[k] = calls[k]()

    threads = [threading.Thread(target=keep, args=(k,)) for k in range(len(calls))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results


def test_a_survey_from_the_future_is_refused(store: Store, tmp_path: Path) -> None:
    """It would be the newest until its time comes, and no later survey would offer a lift."""
    ahead = write_folder(tmp_path / "ahead", age_s=-3600.0, is_simulated=False)
    with pytest.raises(InputError, match=r"is 3[56]\d\d s ahead of this computer's clock; set the clocks"):
        add_survey(store, read_survey(ahead), "ann")
    now = write_folder(tmp_path / "now", shift_m=0.01, is_simulated=False)
    assert add_survey(store, read_survey(now), "ann").is_new


def test_a_survey_stays_where_it_is_when_a_link_to_it_moves_on(store: Store, tmp_path: Path) -> None:
    folders = [write_folder(tmp_path / name, shift_m=shift_m) for name, shift_m in (("a", 0.0), ("b", 0.01))]
    for folder in folders:
        latest = tmp_path / "latest"
        latest.unlink(missing_ok=True)
        latest.symlink_to(folder.name)
        add_survey(store, read_survey(latest), "ann")
    with store.reading() as connection:
        kept = connection.execute(select(SURVEYS.c.folder).order_by(SURVEYS.c.id)).scalars().all()
    assert kept == [str(folder.resolve()) for folder in folders]


def test_two_writers_at_once(store_url: str, tmp_path: Path) -> None:
    yard = CraneYard(0)
    for k in range(2):
        yard.survey(tmp_path / str(k))

    def write(name: str) -> list[AddedSurvey]:
        added = []
        with open_store(store_url, create=True) as store:
            for k in range(2):
                added.append(add_survey(store, read_survey(tmp_path / str(k)), name))
                for _ in range(5):
                    alarm(store, name)
        return added

    first, second = together(lambda: write("ann"), lambda: write("bob"))
    assert isinstance(first, list) and isinstance(second, list)
    assert [one.is_new + other.is_new for one, other in zip(first, second, strict=True)] == [1, 1]
    with open_store(store_url) as store:
        chain = checked(store)
        assert isinstance(chain, AuditChain) and chain.entries == 22
        with store.reading() as connection:
            assert connection.execute(select(func.count()).select_from(SURVEYS)).scalar() == 2


WRITER = """
import os, signal, sys
from pathlib import Path
import barsight.store.audit as audit
from barsight.store.adding import add_survey, read_survey
from barsight.store.opening import open_store
from barsight.store.states import raise_alarm
url, folder = sys.argv[1:]
with open_store(url, create=True) as store:
    print("open", flush=True)
    if folder:
        audit._append = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
        add_survey(store, read_survey(Path(folder)), "ann")
    while True:
        with audit.entry(store, "ann", "alarm") as opened:
            raise_alarm(opened, "rig-drift", "again")
        print("added", flush=True)
"""


@pytest.mark.parametrize("when", ["before the commit", "at any time"])
def test_killed_while_it_writes_leaves_a_valid_store(store_url: str, tmp_path: Path, when: str) -> None:
    folder = tmp_path / "out"
    CraneYard(1).survey(folder)
    with open_store(store_url, create=True) as store:
        alarm(store)
    given = str(folder) if when == "before the commit" else ""
    command = [sys.executable, "-c", WRITER, store_url, given]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None and writer.stdout.readline() == b"open\n"
        if not given:
            for _ in range(5):
                assert writer.stdout.readline() == b"added\n"
            time.sleep(0.01)
            writer.kill()
        assert writer.wait(60) == -signal.SIGKILL
    with open_store(store_url) as store:
        chain = checked(store)
        assert isinstance(chain, AuditChain)
        assert chain.entries == 1 if given else chain.entries > 5
        assert add_survey(store, read_survey(folder), "ann").is_new
        assert isinstance(checked(store), AuditChain)


NEXT = """
import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade():
    op.add_column("alarms", sa.Column("priority", sa.Integer))
    {more}
"""


def next_version(folder: Path, monkeypatch: pytest.MonkeyPatch, more: str = "pass") -> None:
    """As if a later version of the package with one more migration were installed."""
    shutil.copytree(opening.MIGRATIONS, folder, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "versions" / "v0007_next.py").write_text(NEXT.format(more=more), encoding="utf-8")
    monkeypatch.setattr(opening, "MIGRATIONS", folder)


def test_an_earlier_schema_is_brought_up_to_date_after_a_backup(
    store_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with open_store(store_url, create=True) as store:
        alarm(store)
        before = checked(store)
    with monkeypatch.context() as later:
        next_version(tmp_path / "later", later)
        if not store_url.startswith("sqlite"):
            assert run(["store", "list", store_url]) == 2
            said = capsys.readouterr().err
            assert "pg_dump" in said and "--migrate" in said and said.count("\n") == 1
        assert run(["store", "list", store_url, "--migrate"]) == 0
        with open_store(store_url) as store, store.reading() as connection:
            assert connection.execute(text("SELECT priority FROM alarms")).scalars().all() == [None]
    assert run(["store", "verify", store_url]) == 3
    assert "newer version" in capsys.readouterr().err
    if store_url.startswith("sqlite"):
        backup = tmp_path / "yard.db.schema-0006.backup"
        with open_store(f"sqlite:///{backup}") as store:
            assert checked(store) == before


PAST = sorted(path.stem[1:5] for path in (opening.MIGRATIONS / "versions").glob("v*.py"))[:-1]


@pytest.mark.parametrize("revision", PAST)
def test_each_past_schema_is_brought_up_to_date(
    store_url: str, tmp_path: Path, revision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as earlier:
        folder = tmp_path / "earlier"
        shutil.copytree(opening.MIGRATIONS, folder, ignore=shutil.ignore_patterns("__pycache__"))
        for path in (folder / "versions").glob("v*.py"):
            if path.stem[1:5] > revision:
                path.unlink()
        earlier.setattr(opening, "MIGRATIONS", folder)
        with open_store(store_url, create=True) as store:
            alarm(store, "of old")
    with open_store(store_url, migrate=True) as store:
        with store.reading() as connection:
            assert compare_metadata(MigrationContext.configure(connection), METADATA) == []
            assert connection.execute(select(ALARMS.c.reason)).scalars().all() == ["of old"]
        chain = checked(store)
        assert isinstance(chain, AuditChain) and chain.entries == 1
        assert alarm(store) == 2
        if store.engine.dialect.name != "sqlite":  # its triggers fire for each row, theirs for a statement
            for table in METADATA.tables:
                with pytest.raises(DBAPIError, match="only adds rows"), store.writing() as connection:
                    connection.execute(text(f"DELETE FROM {table}"))
    assert store_url.startswith("sqlite") == (tmp_path / f"yard.db.schema-{revision}.backup").is_file()


def test_a_migration_that_fails_changes_nothing(
    store_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_store(store_url, create=True) as store:
        alarm(store)
        before = checked(store)
    with monkeypatch.context() as later:
        next_version(tmp_path / "later", later, more="raise RuntimeError('torn')")
        with pytest.raises(RuntimeError, match="torn"), open_store(store_url, migrate=True):
            pass
    with open_store(store_url) as store:
        assert checked(store) == before
        assert alarm(store) == 2


def test_the_commands_from_an_empty_folder_to_a_tampered_store(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    write_folder(tmp_path / "out")
    for command in (["store", "list"], ["store", "verify"], ["yard"]):
        assert run(command) == 3
    assert not Path("barsight.db").exists()
    assert capsys.readouterr().err.count("barsight store add makes one") == 3
    assert run(["store", "add", "out"]) == 0
    assert run(["store", "add", "sqlite:///barsight.db", "out"]) == 0
    said = capsys.readouterr().out
    assert "2 found" in said and "nothing changed" in said
    assert run(["yard", "--json"]) == run(["store", "list", "--json"]) == run(["yard"]) == 0
    assert '"identity": "B2"' in capsys.readouterr().out
    assert run(["yard", "--at", "2001-01-01T00:00:00Z"]) == 0
    assert "B1" not in capsys.readouterr().out
    assert run(["yard", "--since", "2001-01-01T00:00:00Z", "--json"]) == 0
    changes = json.loads(capsys.readouterr().out)["changes"]
    assert {(one["identity"], one["what"]) for one in changes} == {("B1", "came"), ("B2", "came")}
    assert run(["yard", "--since", "2001-01-01T00:00:00Z"]) == 0
    assert "came" in capsys.readouterr().out
    assert run(["yard", "--since", "2001-01-02T00:00:00Z", "--at", "2001-01-01T00:00:00Z"]) == 2
    assert "name an earlier time" in capsys.readouterr().err
    assert run(["yard", "--since", "2001-01-01T00:00:00Z", "--stock-list", "stock.csv"]) == 2
    assert "leave --since out" in capsys.readouterr().err
    assert run(["store", "verify"]) == 0
    assert "the audit log is valid: 1 rows" in capsys.readouterr().out
    with open_store("sqlite:///barsight.db") as store:
        tamper(store, "UPDATE sightings SET x_m = x_m + 1 WHERE id = 2")
    assert run(["store", "verify"]) == 5
    said = capsys.readouterr().err
    assert "audit row 1 does not hold" in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["store", "list", "barsight.db"], 2, "sqlite:///FILE"),
        (["store", "list", "mysql://host/name"], 2, "SQLite or PostgreSQL"),
        (["store", "list", "sqlite://"], 2, "names no file"),
        (["store", "list", "sqlite:///note.txt"], 3, "not a database"),
        (["store", "verify", "postgresql://user:secret@127.0.0.1:9/none"], 3, "127.0.0.1"),
        (["store", "add", "none"], 3, "no such folder"),
        (["store", "add", "sqlite:///no/yard.db", "out"], 3, "unable to open"),
        (["store", "grow"], 2, "no task of the store 'grow'"),
        (["yard", "sqlite:///note.txt", "--at", "2001-01-01"], 2, "zone"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], code: int, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("note.txt").write_text("no database at all, though of some length " * 20, encoding="utf-8")
    write_folder(tmp_path / "out")
    assert run(arguments) == code
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1 and "secret" not in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["note.txt", "out"]


def test_a_missing_extra_is_named(tmp_path: Path) -> None:
    script = (
        "import sys; sys.modules['sqlalchemy'] = None\n"
        "from barsight.cli.main import run; sys.exit(run(['store', 'list']))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert "pip install 'barsight[store]'" in done.stderr and done.stderr.count("\n") == 1


def test_times_are_exact() -> None:
    assert parse_time("1700000000000000001") == 1700000000000000001
    assert parse_time("2023-11-14T23:13:20.000001+01:00") == 1700000000000001000


@pytest.mark.parametrize("time", ["9999-12-31T00:00:00Z", "0001-01-01T00:00:00Z", "9" * 30])
def test_a_time_that_no_store_can_hold_is_one_line(
    store: Store, time: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with entry(store, "ann", "calibration") as opened:
        note_calibration(opened, "ca1b")
        with pytest.raises(ConfigError, match="leave it out"):
            approve_calibration(opened, "ca1b", 0, 10**21)
    url = store.engine.url.render_as_string(hide_password=False)
    for arguments in (["store", "approve", url, "ca1b", "--valid-until", time], ["yard", url, "--at", time]):
        assert run(arguments) == 2
        assert "from 1970 to 2262" in capsys.readouterr().err


def test_a_server_that_may_only_be_read_or_whose_writer_hangs_is_one_line(
    server: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a failover, or while a writer's computer has lost its network: neither ends a thread."""
    with open_store(add_database(server, f"yard_{uuid.uuid4().hex}"), create=True) as store:
        monkeypatch.setattr(opening, "WAIT_S", 0.2)
        with store.writing(), pytest.raises(InputError, match="lock timeout"):
            alarm(store)
        monkeypatch.setattr(opening, "IDLE_S", 0.2)
        with pytest.raises(InputError, match="idle-in-transaction timeout"), store.writing() as connection:
            time.sleep(0.6)
            connection.execute(text("SELECT 1"))
        alarm(store)
        with store.engine.begin() as connection:
            name = store.engine.url.database
            connection.execute(text(f'ALTER DATABASE "{name}" SET default_transaction_read_only = on'))
        store.engine.dispose()
        with pytest.raises(OutputError, match="read-only"):
            alarm(store)
        with psycopg.connect(host=server, user="postgres", dbname="postgres", autocommit=True) as connection:
            connection.execute(f'ALTER DATABASE "{name}" RESET default_transaction_read_only'.encode())
        alarm(store)  # on a new connection, as the kept one may only read


def test_a_user_without_the_right_to_write_is_told_in_one_line(server: str) -> None:
    url = add_database(server, f"yard_{uuid.uuid4().hex}")
    with open_store(url, create=True) as store, store.engine.begin() as connection:
        connection.execute(text("CREATE ROLE reader LOGIN"))
        connection.execute(text("GRANT SELECT ON ALL TABLES IN SCHEMA public TO reader"))
    try:
        with open_store(url.replace("postgres@", "reader@")) as store:
            with pytest.raises(OutputError, match="permission denied") as refused:
                alarm(store)
            assert "\n" not in str(refused.value)
    finally:
        with open_store(url) as store, store.engine.begin() as connection:
            connection.execute(text("DROP OWNED BY reader"))
            connection.execute(text("DROP ROLE reader"))


def test_vetoes_are_kept_for_the_map_and_for_its_bundles(store: Store, tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "out", age_s=1e6)
    assert lifts(folder) == 0
    add_survey(store, read_survey(folder), "ann")
    with store.reading() as connection:
        rows = connection.execute(select(SURVEY_VETOES.c.bundle_id, SURVEY_VETOES.c.code)).all()
        assert connection.execute(select(func.count()).select_from(LIFTS)).scalar() == 0
    assert {(None, "map-too-old"), (1, "map-too-old"), (2, "map-too-old")} <= {tuple(row) for row in rows}


def test_the_audit_log_and_the_tables_have_their_names(store: Store) -> None:
    number = alarm(store)
    with store.reading() as connection:
        (row,) = connection.execute(select(AUDIT)).all()
        assert connection.execute(select(ALARMS.c.id)).scalars().all() == [number]
    assert (row.who, row.what) == ("ann", "alarm")


def test_the_newest_and_the_first_sightings_are_those_of_a_plain_search(store: Store) -> None:
    """Surveys in any order of time, several at one time."""
    rng, rows, looked = np.random.default_rng(2), [], []
    with entry(store, "ann", "surveys") as opened:
        bundles = []
        for number in range(30):
            at_ns = int(rng.integers(1, 15))
            survey_id = opened.add(
                SURVEYS, map_id=f"m{number}", captured_from_ns=0, captured_to_ns=at_ns, added_ns=0,
                calibration_id="", is_simulated=True, software_version="", folder="", files="", heights=b"",
            )  # fmt: skip
            bundles = bundles or [opened.add(BUNDLES, survey_id=survey_id) for _ in range(20)]
            for k, bundle_id in enumerate(rng.permutation(bundles)[:8].tolist()):
                figures = dict.fromkeys(("x_m", "y_m", "top_z_m", "yaw_deg", "length_m", "width_m"), 0.0)
                seen = {"survey_id": survey_id, "bundle_id": bundle_id}
                if k < 6:
                    opened.add(SIGHTINGS, **seen, number=k, change="same", **figures, record="{}")
                    rows.append((bundle_id, at_ns, survey_id))
                else:
                    opened.add(ABSENCES, **seen, kind="gone", reason=str(survey_id))
                    looked.append((bundle_id, at_ns, survey_id))
    with store.reading() as connection:
        for limit in range(16):
            newest = {bundle: survey for bundle, at, survey in sorted(rows) if at <= limit}
            found = newest_sightings(connection, limit)
            assert {number: one.survey_id for number, one in found.items()} == newest
            oldest = {bundle: survey for bundle, at, survey in sorted(rows)[::-1] if at > limit}
            found = next_sightings(connection, limit)
            assert {number: one.survey_id for number, one in found.items()} == oldest
            absent = {bundle: str(survey) for bundle, at, survey in sorted(looked) if at <= limit}
            found_absent = newest_absences(connection, limit)
            assert {number: one.reason for number, one in found_absent.items()} == absent


def test_lists_of_surveys_leave_their_heights_where_they_are(store: Store) -> None:
    """With 5000 surveys of a large yard they are gigabytes."""
    asked: list[str] = []
    event.listen(store.engine, "before_cursor_execute", lambda *given: asked.append(given[2]))
    with store.reading() as connection:
        assert list_surveys(connection) == () and survey_records(connection) == []
        assert newest_survey(connection) is None
    assert len(asked) > 5 and not [query for query in asked if "heights" in query]


def test_each_bundle_of_a_written_list_has_a_name_of_its_own() -> None:
    """A list may call a bundle as the store calls another one."""

    def shown(identity: str, stock_name: str | None) -> PresentBundle:
        sighting = SimpleNamespace(identity=identity, stock_name=stock_name, bundle=record(laid(0.3)))
        return PresentBundle(cast(BundleSighting, sighting), None)

    called = (("B1", "B2"), ("B2", None), ("B3", "B2"), ("B4", "B2 (2)"))
    names = [one.name for one in listed_bundles(shown(*one) for one in called)]
    assert names == ["B2", "B2 (2)", "B3", "B4"]
