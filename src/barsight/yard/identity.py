"""Identify a map, so that results from it can't be mistaken for another map's."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import barsight
from barsight.core.errors import InputError

ID_DIGITS = 16


@dataclass(frozen=True)
class MapIdentity:
    """A map to which files belong.

    map_id: digest of the map and of everything its lifts depend on. captured_from_ns, captured_to_ns: stamps
    of its first and last frame, None where unknown. calibration_id, yard_frame_id: digests of the cameras'
    rig and of its mounting on the crane, None where there is no crane. height_sha256: of height.tif.
    """

    map_id: str
    is_simulated: bool
    captured_from_ns: int | None
    captured_to_ns: int | None
    calibration_id: str
    yard_frame_id: str | None
    height_sha256: str

    def header(self, sequence: int) -> dict[str, Any]:
        """Build the header of this map's files. sequence: counts the files written of the same map."""
        software = {"name": "barsight", "version": barsight.__version__}
        return {"software": software, **asdict(self), "sequence": sequence}

    def expect(self, path: Path, content: dict[str, Any], remedy: str) -> None:
        """Raise InputError where a file's content belongs to another map."""
        if content.get("map_id") != self.map_id:
            problem = f"belongs to another map ({content.get('map_id')}, this one is {self.map_id})"
            raise InputError(path, problem, remedy)


def expect_same_frame(path: Path, found: str | None, before: str | None, whose: str) -> None:
    """Raise InputError where two maps are in different yard frames, by their digests (None where unknown).
    whose: name of the other map in the message.
    """
    if None not in (found, before) and found != before:
        problem = f"lies in another yard frame ({found}) than {whose} ({before})"
        remedy = "measure both with one yard file; --same-yard says that both frames are of one surveyed yard"
        raise InputError(path, problem, remedy)
