"""Save checkpoints of a run: complete results, stored as data next to the output until the run succeeds."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

import barsight
from barsight.core.compiling.sources import sources_digest
from barsight.core.errors import Failed, InputError
from barsight.core.files import atomic_path
from barsight.core.json_values import json_digest, json_value
from barsight.core.motion_detail import InertialStates, MotionDetail, NormalisedResiduals, RelativePoses
from barsight.core.pose import Pose
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair, RefusedFrame
from barsight.core.records.trajectory import PosedFrame, RigDrift, Trajectory
from barsight.mapping.free_space import FreeSpace
from barsight.mapping.recording_probe import RecordingProbe
from barsight.mapping.surface.surface import Surface
from barsight.mapping.top_photo import TopPhoto
from barsight.mapping.view import MatchedFrame
from barsight.measure_settings import MeasureSettings
from barsight.measurement import BuiltMap, Preview, Refusal
from barsight.recording.base import Recording
from barsight.recording.formats.image_folders import PictureFiles
from barsight.yard_frame import frame_of

T = TypeVar("T")

_RECORDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        Trajectory,
        PosedFrame,
        RefusedFrame,
        Pose,
        RigDrift,
        MotionDetail,
        InertialStates,
        NormalisedResiduals,
        RelativePoses,
        MatchedFrame,
        RectifiedPair,
        RectifiedCamera,
        Disparity,
        Failed,
        RecordingProbe,
        DisparityRange,
        BuiltMap,
        Surface,
        FreeSpace,
        TopPhoto,
        Refusal,
        Preview,
    )
}
_TORN = (
    OSError, EOFError, ValueError, KeyError, TypeError, AttributeError, RecursionError, NotImplementedError,
    zipfile.BadZipFile,
)  # fmt: skip
"""Exceptions raised when reading a file that is truncated or of another kind."""


def checkpoint_folder(root: Path, key: str) -> Path:
    """Create the folder of one measurement under `root`, and delete everything else there.

    key: identifies everything that the results depend on. Raises InputError where `root` or the folder is a
    link, a file or another user's; nothing is deleted there.
    """
    folder = root / key[:32]
    _make_own(root)
    for other in root.iterdir():
        if other != folder:
            shutil.rmtree(other) if other.is_dir() and not other.is_symlink() else other.unlink()
    _make_own(folder)
    return folder


def _make_own(folder: Path) -> None:
    with contextlib.suppress(FileExistsError):
        folder.mkdir(parents=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
        raise InputError(folder, "is not this user's own folder", "remove it, or name another OUT")


def checkpoint_key(
    recording: Recording, source: Recording, settings: MeasureSettings, inputs: dict[str, str]
) -> str:
    """Return a digest of everything that trajectory, disparities and map depend on, including the package's
    sources.

    source: the recording with the sensors in use, in the yard. inputs: SHA-256 of its files.
    """
    sources = sources_digest(Path(barsight.__file__).parent)
    configuration, frame = json_value(settings), frame_of(source)
    stages = {name: part for name, part in configuration.items() if name not in ("bundles", "lift")}
    placed = inputs if frame is None else {**inputs, "yard": frame.digest}
    rig = json_value(recording.rig)
    return json_digest([sources, stages, placed, rig, pictures_digest(recording)])


def pictures_digest(recording: Recording) -> str:
    """Compute the SHA-256 of all picture files of a recording; empty for a bag, whose whole file is in
    `digests`.
    """
    if not isinstance(recording, PictureFiles):
        return ""
    found = hashlib.sha256()
    for image in recording.stored_images():
        found.update(f"{image.camera} {image.stamp_ns} {len(image.data)} ".encode())
        found.update(image.data)
    return found.hexdigest()


def checkpointed(folder: Path | None, name: str, make: Callable[[], T]) -> T:
    """Load the checkpoint of this name, or compute and save make(); without a folder nothing is saved.

    The file is written atomically; a damaged one is computed again.
    """
    if folder is None:
        return make()
    file = folder / f"{name}.npz"
    if file.is_file():
        try:
            kept: T = read_checkpoint(file)
        except _TORN:
            pass
        else:
            return kept
    made = make()
    with atomic_path(file) as path:
        _write(made, path, folder)
    return made


def trajectory_name(recording: Recording, delay_ns: int | None) -> str:
    """Name the checkpoint of a trajectory after the frames and readings that it depends on: readings up to
    delay_ns after the last frame, or all of them if that is None.
    """
    stamps = np.array(recording.index.stamps_ns, np.int64)
    found = hashlib.sha256(stamps.tobytes())
    for readings in sensor_readings(recording):
        count = readings[0].size
        if delay_ns is not None and stamps.size:
            until_ns = int(stamps[-1]) + recording.rig.timeshift_cam_imu_ns + delay_ns
            count = int(np.searchsorted(readings[0], until_ns, side="right"))
        for values in readings:
            found.update(np.ascontiguousarray(values[:count]).tobytes())
    return f"trajectory_{found.hexdigest()[:32]}"


def sensor_readings(recording: Recording) -> list[tuple[NDArray[Any], ...]]:
    """List the readings of encoders and IMU, the time stamps first."""
    crane, imu = recording.crane(), recording.imu()
    found: list[tuple[NDArray[Any], ...]] = []
    if crane is not None:
        found.append((crane.stamp_ns, crane.position_m))
    if imu is not None:
        found.append((imu.stamp_ns, imu.gyro_radps, imu.accel_mps2))
    return found


def _write(value: Any, path: Path, beside: Path) -> None:
    """Write frozen records as an npz file: the arrays, and a JSON tree of everything else; the files of
    folders named in them are linked into a new folder in `beside`.
    """
    arrays: dict[str, Any] = {}
    tree = json.dumps(_plain(value, arrays, beside)).encode()
    with path.open("wb") as stream:
        np.savez(stream, tree=np.frombuffer(tree, np.uint8), **arrays)


def read_checkpoint(path: Path) -> Any:
    """Read a checkpoint that `checkpointed` wrote."""
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        found = _record(json.loads(file["tree"].tobytes()), file, path.parent)
    if not is_dataclass(found):
        raise ValueError("a checkpoint holds a record")
    return found


def _plain(value: Any, arrays: dict[str, Any], beside: Path) -> Any:
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if is_dataclass(value):
        kind = type(value).__name__
        content = {field.name: _plain(getattr(value, field.name), arrays, beside) for field in fields(value)}
        assert kind in _RECORDS, f"{kind} is kept nowhere"
        return {"kind": kind, "fields": content}
    if isinstance(value, Mapping):
        return {"pairs": [[_plain(item, arrays, beside) for item in pair] for pair in value.items()]}
    if isinstance(value, frozenset):
        return {"members": [_plain(item, arrays, beside) for item in sorted(value)]}
    if isinstance(value, Path):
        return {"folder": _linked(value, beside).name}
    if isinstance(value, tuple):
        return [_plain(item, arrays, beside) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _linked(folder: Path, beside: Path) -> Path:
    made = Path(tempfile.mkdtemp(prefix="files_", dir=beside))
    for file in folder.iterdir():
        os.link(file, made / file.name)
    return made


def _record(tree: Any, arrays: Any, beside: Path) -> Any:
    if isinstance(tree, list):
        return tuple(_record(item, arrays, beside) for item in tree)
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "pairs" in tree:
        return {_record(key, arrays, beside): _record(item, arrays, beside) for key, item in tree["pairs"]}
    if "members" in tree:
        return frozenset(_record(tree["members"], arrays, beside))
    if "folder" in tree:
        return beside / Path(tree["folder"]).name
    content = {name: _record(item, arrays, beside) for name, item in tree["fields"].items()}
    return _RECORDS[tree["kind"]](**content)
