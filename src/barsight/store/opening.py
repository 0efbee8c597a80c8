"""Open a store: find the database, bring its tables up to date, provide connections."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from barsight.core.errors import ConfigError, InputError, OutputError
from barsight.core.extras import extra
from barsight.core.files import atomic_path
from barsight.core.wall_clock import WallClock
from barsight.store.tables import MAX_ID, METADATA

with extra("store"):
    from alembic import command
    from alembic.config import Config
    from alembic.runtime.migration import MigrationContext
    from alembic.script import ScriptDirectory
    from sqlalchemy import URL, Connection, Engine, create_engine, event, inspect, make_url, text
    from sqlalchemy.exc import ArgumentError, DatabaseError, NoSuchModuleError, OperationalError

DEFAULT_URL = "sqlite:///barsight.db"
MIGRATIONS = Path(__file__).parent / "migrations"
WAIT_S = 60
"""Time in seconds that a writer waits for another one."""
IDLE_S = 300
"""Time after which PostgreSQL ends a writer of which it hears nothing: its computer may be gone."""
_LOCK = 0x62617273
"""PostgreSQL advisory lock that writers of a store take."""


@dataclass
class SeenLog:
    """Newest row of the audit log that was seen: its id, 0 for none, and its digest.

    path: file that keeps it for the next process, beside a SQLite file that may be put back; None for
    PostgreSQL.
    """

    path: Path | None = None
    newest: tuple[int, str] = (0, "")

    def __post_init__(self) -> None:
        if self.path is not None:
            with suppress(OSError, ValueError):
                number, digest = self.path.read_text(encoding="ascii").split()
                self.newest = min(int(number), MAX_ID), digest

    def note(self, newest: tuple[int, str]) -> None:
        """Keep the newest row; where no file can be written, only for this process."""
        if newest == self.newest:
            return
        self.newest = newest
        if self.path is not None:
            with suppress(OSError, OutputError), atomic_path(self.path) as path:
                path.write_text(f"{newest[0]} {newest[1]}\n", encoding="ascii")


@dataclass(frozen=True)
class Store:
    """An open store. engine: the SQLAlchemy engine. name: its URL without the password. clock, log: by which
    this process notices that the computer's clock, or the store itself, was set back.
    """

    engine: Engine
    name: str
    clock: WallClock = field(default_factory=WallClock)
    log: SeenLog = field(default_factory=SeenLog)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Provide a connection in a read-only transaction."""
        with _translated_errors(self.name), self.engine.connect() as connection:
            if not self._is_sqlite:
                connection.execute(text("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ, READ ONLY"))
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """Provide a connection in an exclusive write transaction; it commits unless an error is raised."""
        writer = self.engine.execution_options(is_writer=True)
        with _translated_errors(self.name, writer), writer.begin() as connection:
            if not self._is_sqlite:
                limits = {"lock_timeout": WAIT_S, "idle_in_transaction_session_timeout": IDLE_S}
                calls = (f"set_config('{name}', '{1e3 * s:.0f}', true)" for name, s in limits.items())
                connection.execute(text(f"SELECT {', '.join(calls)}"))
                connection.execute(text(f"SELECT pg_advisory_xact_lock({_LOCK})"))
            yield connection

    @property
    def _is_sqlite(self) -> bool:
        return self.engine.dialect.name == "sqlite"


@contextmanager
def open_store(url: str, *, create: bool = False, migrate: bool = False) -> Iterator[Store]:
    """Open a store and close it at the end.

    create: whether to create a missing one. migrate: whether tables of an earlier version on PostgreSQL may
    be brought up to date; a SQLite file is backed up and brought up to date in any case. Raises ConfigError
    for an invalid URL, InputError for an unusable database.
    """
    parsed = _parse(url)
    log = SeenLog()
    if parsed.get_backend_name() == "sqlite":
        log = SeenLog(_seen_path(parsed, create=create))
    store = Store(_engine(parsed), parsed.render_as_string(hide_password=True), log=log)
    try:
        _bring_up_to_date(store, parsed, create=create, migrate=migrate)
        yield store
    finally:
        store.engine.dispose()


def _parse(url: str) -> URL:
    try:
        parsed = make_url(url)
    except ArgumentError as error:
        remedy = "write sqlite:///FILE or postgresql://USER@HOST/NAME"
        raise ConfigError(f"{url!r} is not a database URL; {remedy}") from error
    if parsed.get_backend_name() not in ("sqlite", "postgresql"):
        raise ConfigError(f"{parsed.get_backend_name()}: a store is in SQLite or PostgreSQL")
    if parsed.get_backend_name() == "sqlite" and parsed.database in (None, "", ":memory:"):
        raise ConfigError(f"{url}: names no file; write sqlite:///FILE")
    return parsed


def _seen_path(url: URL, *, create: bool) -> Path:
    """Return the file of `SeenLog`, without an earlier store's. Raises InputError if there is no store."""
    path = Path(str(url.database))
    seen = path.with_name(f"{path.name}.seen")
    if not path.is_file():
        if not create:
            raise InputError(path, "there is no such store", "barsight store add makes one")
        with suppress(OSError):
            seen.unlink()
    return seen


def _engine(url: URL) -> Engine:
    is_sqlite = url.get_backend_name() == "sqlite"
    options: dict[str, Any] = {"timeout": WAIT_S} if is_sqlite else {"connect_timeout": 10}
    try:
        with extra("store" if is_sqlite else "postgres"):
            engine = create_engine(url, connect_args=options)
    except NoSuchModuleError as error:
        raise ConfigError(f"{url.drivername}: SQLAlchemy knows no such driver") from error
    if is_sqlite:
        event.listen(engine, "connect", _set_up_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
    return engine


def _set_up_sqlite(connection: Any, _: Any) -> None:
    """Leave BEGIN to `_begin_sqlite`: the driver's own comes after the first read, and not before DDL."""
    connection.isolation_level = None
    connection.execute("PRAGMA foreign_keys = ON")
    connection.execute("PRAGMA synchronous = FULL")


def _begin_sqlite(connection: Connection) -> None:
    """Take the write lock at once, so that no other writer intervenes between its reads and writes."""
    is_writer = connection.get_execution_options().get("is_writer")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if is_writer else "BEGIN")


_READ_ONLY = "25006"
_UNWRITTEN = ("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_READONLY", _READ_ONLY, "42501")
"""Codes of SQLite's, and PostgreSQL's of a server that may only be read, as after a failover, and of a user
without the right.
"""
_TOO_IDLE = "25P03"
_MOVED = "SQLITE_READONLY_DBMOVED"
"""Code of SQLite's if another file took the place of the one that is open."""


@contextmanager
def _translated_errors(name: str, writer: Engine | None = None) -> Iterator[None]:
    """Convert the error of a database that can't be reached, read or written into an InputError of one line,
    or into an OutputError if it could not or may not be written.

    A statement that the database rejects is a bug and raised unchanged.
    """
    try:
        yield
    except UnicodeDecodeError as error:  # in SQLite's message about a damaged file
        raise InputError(name, "is damaged", "take the newest backup beside it") from error
    except DatabaseError as error:
        code = getattr(error.orig, "sqlite_errorname", None) or getattr(error.orig, "sqlstate", None) or ""
        is_unwritten = code.startswith(_UNWRITTEN)
        is_known = is_unwritten or code == _TOO_IDLE or isinstance(error, OperationalError)
        if not is_known and type(error) is not DatabaseError:
            raise
        problem = str(error.orig).strip().splitlines()[0]
        if is_unwritten:
            if writer is not None and code in (_READ_ONLY, _MOVED):
                writer.dispose()  # kept connections would stay with what the server, or the file, was before
            raise OutputError(f"{name}: {problem}; free some space, or see that it may be written") from error
        raise InputError(
            name, problem, "see that the database is there, is a store and may be written"
        ) from error


def _bring_up_to_date(store: Store, url: URL, *, create: bool, migrate: bool) -> None:
    """Migrate inside the write transaction: if it is killed, the database is unchanged."""
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    config.set_main_option("version_locations", str(MIGRATIONS / "versions").replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    script = ScriptDirectory.from_config(config)
    newest = str(script.get_current_head())
    with store.reading() as connection:
        if MigrationContext.configure(connection).get_current_revision() == newest:
            return
    with store.writing() as connection:
        found = MigrationContext.configure(connection).get_current_revision()
        if found == newest:
            return  # another process created it in the meantime
        _expect_migration(store.name, connection, found, script, create=create)
        if found is not None:
            _back_up(store.name, url, found, migrate=migrate)
        config.attributes["connection"] = connection
        command.upgrade(config, "head")


def _expect_migration(
    name: str, connection: Connection, found: str | None, script: ScriptDirectory, *, create: bool
) -> None:
    """Raise InputError if a database's tables aren't those of a store, or are of a newer version."""
    if found is None:
        if set(inspect(connection).get_table_names()) & set(METADATA.tables):
            raise InputError(name, "has tables of another program", "name a database of its own")
        if not create:
            raise InputError(name, "there is no store in it", "barsight store add makes one")
    elif found not in {each.revision for each in script.walk_revisions()}:
        raise InputError(name, f"was written by a newer version (schema {found})", "update Barsight")


def _back_up(name: str, url: URL, found: str, *, migrate: bool) -> None:
    """Copy a SQLite file while its write lock is held; on PostgreSQL ask the operator."""
    if url.get_backend_name() != "sqlite":
        if not migrate:
            raise ConfigError(
                f"{name}: has schema {found} of an earlier version; back it up with pg_dump, then run "
                "barsight store list URL --migrate"
            )
        return
    path = Path(str(url.database))
    # SQLite's own backup: closing a separately opened file would release SQLite's locks on it.
    with (
        atomic_path(path.with_name(f"{path.name}.schema-{found}.backup")) as backup,
        closing(sqlite3.connect(path)) as source,
        closing(sqlite3.connect(backup)) as target,
    ):
        source.backup(target)
