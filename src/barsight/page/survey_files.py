"""Find a survey's files for whoever asks for one by name."""

from __future__ import annotations

import json
from pathlib import Path

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.result_folder import file_digest
from barsight.store.tables import SURVEYS

with extra("store"):
    from sqlalchemy import Connection, select

UNSEALED = ("report.html", "ortho.png")
"""Files that the store keeps no digest of."""


def find_file(connection: Connection, map_id: str, name: str) -> Path:
    """Return a file's path, held against its digest. Raises InputError where it can't be had."""
    row = connection.execute(select(SURVEYS).where(SURVEYS.c.map_id == map_id)).first()
    if row is None:
        raise InputError(map_id, "there is no such survey")
    digests = json.loads(row.files)
    if name not in digests and name not in UNSEALED:
        raise InputError(name, f"is no file of survey {map_id}")
    path = Path(row.folder) / name
    if not path.is_file():
        raise InputError(path, "is not there any more")
    if name in digests and file_digest(path) != digests[name]:
        raise InputError(path, "was changed after the survey was added")
    return path
