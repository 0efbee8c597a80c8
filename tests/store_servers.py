"""Databases for the tests of the store: a SQLite file, or PostgreSQL where it is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg
import pytest

_VERSIONS = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
"""Where Debian puts the server's programs."""


def find_program(name: str) -> str | None:
    return shutil.which(name, path=os.pathsep.join(map(str, _VERSIONS))) or shutil.which(name)


@contextmanager
def postgres() -> Iterator[str]:
    """A PostgreSQL of its own, reached through a socket in a temporary folder; yields the folder.

    Skips where there is none, saying so. initdb refuses root, so that root runs it as the user `postgres`.
    """
    initdb, control = find_program("initdb"), find_program("pg_ctl")
    if initdb is None or control is None:
        pytest.skip("PostgreSQL is not installed (Debian: apt-get install postgresql-15)")
    folder = Path(tempfile.mkdtemp(prefix="barsight-pg-"))
    user = "postgres" if os.geteuid() == 0 else None
    if user is not None:
        shutil.chown(folder, user)

    def call(*command: str) -> None:
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder, user=user, group=user)

    data = str(folder / "data")
    options = f"-k {folder} -c listen_addresses= -c fsync=off -c shared_buffers=16MB"
    try:
        call(initdb, "-D", data, "-U", "postgres", "-A", "trust", "--no-sync", "-E", "UTF8")
        call(control, "-D", data, "-o", options, "-w", "-l", str(folder / "log"), "start")
        try:
            yield str(folder)
        finally:
            call(control, "-D", data, "-m", "immediate", "-w", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def add_database(folder: str, name: str) -> str:
    """Create a database on the server whose socket lies in a folder; return its URL."""
    with psycopg.connect(host=folder, user="postgres", dbname="postgres", autocommit=True) as connection:
        connection.execute(f'CREATE DATABASE "{name}"'.encode())
    return f"postgresql+psycopg://postgres@/{name}?host={folder}"
