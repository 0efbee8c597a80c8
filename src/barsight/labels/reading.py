"""Read the labels of a measured yard from its recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import barsight
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import InputError
from barsight.core.json_values import write_json
from barsight.labels.attachment import Label, contradictions, merge_codes
from barsight.labels.bundle_labels import ILLEGIBLE, bundle_label, read_texts, unread_label
from barsight.labels.placing import pose_at
from barsight.recording.base import Recording
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.result_folder import open_folder, read_heights, read_path
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.inventory.stock_list import ListedBundle
from barsight.yard.label_settings import LabelSettings
from barsight.yard_frame import calibration_id

SCHEMA_VERSION = 1
FILE = "labels.json"


@dataclass(frozen=True, eq=False)
class ReadLabels:
    """The labels of a yard. pictures: number of pictures read. illegible: ids of bundles whose label is
    seen but not read with certainty. contradictions: sentences about contradictions with the stock list.
    """

    map_id: str
    pictures: int
    labels: tuple[Label, ...]
    illegible: tuple[int, ...]
    contradictions: tuple[str, ...]


def read_labels(
    recording: Recording, folder: Path, listed: tuple[ListedBundle, ...], settings: LabelSettings,
    count: Callable[[], None],
) -> ReadLabels:  # fmt: skip
    """Read the labels in a recording's pictures and locate them on the map in `folder`.

    count: called after each pair, twice if plain numbers are read. Raises InputError where the folder is not
    of this recording and rig or has no trajectory, ConfigError without the extra `labels`.
    """
    said, _ = open_folder(folder)
    _expect_own(recording, folder, said)
    path = read_path(folder)
    if path is None:
        raise InputError(folder, "has no trajectory.tum", "measure the recording again")
    bundles, heights = read_bundles(folder / "bundles.json"), read_heights(folder)
    pairs = RectifiedPairs(recording, Rectifier(recording.rig))
    poses = {stamp: pose for stamp in recording.index.stamps_ns if (pose := pose_at(path, stamp)) is not None}
    labels = merge_codes(read_texts(pairs, poses, heights, bundles, settings, count), bundles)
    illegible = tuple(
        bundle.id for bundle in bundles
        if (bundle_label(bundle, labels) or unread_label(bundle, heights, settings.size_m)) == ILLEGIBLE
    )  # fmt: skip
    return ReadLabels(
        said["map_id"], 2 * len(poses), labels, illegible, contradictions(labels, bundles, listed)
    )


def _expect_own(recording: Recording, folder: Path, said: dict[str, Any]) -> None:
    """Raise InputError where a folder wasn't measured from a recording, or with another rig."""
    own, passes = recording.digests(), said.get("passes") or ()
    for inputs in [one["inputs"] for one in passes] or [said["hashes"]["inputs"]]:
        shared = own.keys() & inputs.keys()
        has_data = any(Path(name).suffix not in (".yaml", ".yml") for name in shared)
        if has_data and all(own[name] == inputs[name] for name in shared):
            break
    else:
        remedy = "name the recording that it was measured from"
        raise InputError(folder, f"is not the result of {recording.path}", remedy)
    if not passes and calibration_id(recording.rig) != said["calibration_id"]:
        raise InputError(folder, "was measured with another rig", "name its rig file: --rig RIG")


def write_labels(found: ReadLabels, folder: Path) -> Path:
    """Write labels.json to a result folder."""
    content: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "software": f"barsight {barsight.__version__}",
        "map_id": found.map_id,
        "pictures": found.pictures,
        "labels": [
            {
                "text": one.text, "kind": one.kind, "x_m": round(float(one.place_m[0]), 4),
                "y_m": round(float(one.place_m[1]), 4), "z_m": round(float(one.place_m[2]), 4),
                "pictures": one.pictures, "agreement_ratio": round(one.agreement_ratio, 3),
                "is_sure": one.is_sure, "bundle": one.bundle, "doubts": list(one.doubts),
            }
            for one in found.labels
        ],
        "illegible": list(found.illegible),
        "contradictions": list(found.contradictions),
    }  # fmt: skip
    target = folder / FILE
    write_json(target, content)
    return target
