"""Find a survey's folder, and its files by name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.page.access import AccessError
from barsight.result_folder import file_digest, open_folder
from barsight.store.tables import SURVEY_FACTS, SURVEYS

with extra("store"):
    from sqlalchemy import Connection, select

UNSEALED = ("report.html", "ortho.png")
"""Files for which the store keeps no digest."""


def survey_folder(connection: Connection, map_id: str) -> Path:
    """Return a survey's folder. Raises AccessError if there is no such survey."""
    folder = connection.execute(select(SURVEYS.c.folder).where(SURVEYS.c.map_id == map_id)).scalar()
    if folder is None:
        raise AccessError(404, f"there is no survey {map_id}")
    return Path(folder)


def expect_map(folder: Path, map_id: str) -> dict[str, Any]:
    """Return a folder's result.json. Raises InputError if the folder isn't as it was added."""
    summary, identity = open_folder(folder)
    if identity is None or identity.map_id != map_id:
        raise InputError(folder, f"holds another map than {map_id}", "measure into a folder of its own")
    return summary


def find_file(connection: Connection, map_id: str, name: str) -> Path:
    """Return a file's path after a check of its digest. Raises InputError if it is missing or changed."""
    row = connection.execute(select(*SURVEY_FACTS).where(SURVEYS.c.map_id == map_id)).first()
    if row is None:
        raise InputError(map_id, "there is no such survey")
    digests = json.loads(row.files)
    if name not in digests and name not in UNSEALED:
        raise InputError(name, f"is not a file of survey {map_id}")
    path = Path(row.folder) / name
    if not path.is_file():
        raise InputError(path, "is not there any more")
    if name in digests and file_digest(path) != digests[name]:
        raise InputError(path, "was changed after the survey was added")
    return path
