"""Open a recording of any format: `open_recording` examines the path and chooses the right reader."""

from __future__ import annotations

from pathlib import Path

from barsight.calibration.boards.detection_files import has_detections
from barsight.core.errors import InputError
from barsight.recording.base import RecordingSettings
from barsight.recording.formats.bag import BagRecording
from barsight.recording.formats.bag_file import BAG_KINDS, BagFile
from barsight.recording.formats.board_corners import CornerRecording
from barsight.recording.formats.euroc import EurocRecording
from barsight.recording.formats.kitti import KittiRecording, is_kitti
from barsight.recording.formats.segments import SEGMENTS, segments_of
from barsight.recording.stored_images import StoredPictures

KNOWN = (
    "an EuRoC folder (holding mav0), a KITTI odometry sequence (calib.txt, image_0, image_1), a ROS 1 .bag, "
    "a ROS 2 bag folder (metadata.yaml), a folder of live's segments, a .mcap, a .db3 or a board's corners "
    "(camN_detections.npz)"
)


def open_recording(path: Path, settings: RecordingSettings | None = None) -> StoredPictures:
    """Open the recording at `path`, of any format; calibration and the lists of pictures are checked.

    Raises `InputError` for a missing folder or an unknown format, and the errors of the readers.
    """
    try:
        return _open(path, settings or RecordingSettings())
    except PermissionError as error:
        name = error.filename or path
        raise InputError(name, "no permission to read it", "ask its owner or copy the recording") from None


def _open(path: Path, settings: RecordingSettings) -> StoredPictures:
    if not path.exists():
        raise InputError(path, "no such file or folder", "check the path")
    if path.is_file():
        if path.suffix not in BAG_KINDS:
            raise InputError(path, "is of an unknown file type", f"give {KNOWN}")
        return BagRecording(path, path, BAG_KINDS[path.suffix], settings)
    if any((path / name).is_dir() for name in ("mav0", "cam0", "cam1")):
        return EurocRecording(path, settings)
    if segments_of(path):
        return BagRecording(path, path, SEGMENTS, settings)
    bags = sorted(file for file in path.iterdir() if file.suffix in BAG_KINDS and file.is_file())
    if (path / "metadata.yaml").is_file() or bags:
        return _open_bag_folder(path, bags, settings)
    if has_detections(path):
        return CornerRecording(path, settings)
    if is_kitti(path):
        return KittiRecording(path, settings)
    raise InputError(path, "is not a recording that Barsight recognises", f"give {_hint(path) or KNOWN}")


def bag_at(path: Path) -> BagFile | None:
    """Open the bag at `path`, whatever it contains; None if there is none. Raises `InputError`."""
    if path.is_dir():
        is_bag = (path / "metadata.yaml").is_file()
    else:
        is_bag = path.is_file() and path.suffix in BAG_KINDS
    return BagFile(path) if is_bag else None


def _open_bag_folder(path: Path, bags: list[Path], settings: RecordingSettings) -> BagRecording:
    kinds = {BAG_KINDS[bag.suffix] for bag in bags}
    if (path / "metadata.yaml").is_file():
        return BagRecording(path, path, kinds.pop() if len(kinds) == 1 else "ros2", settings)
    if len(bags) > 1:
        names = ", ".join(bag.name for bag in bags)
        raise InputError(
            path,
            f"holds several bags and no metadata.yaml: {names}",
            "name one of them, or `ros2 bag reindex`",
        )
    return BagRecording(path, bags[0], kinds.pop(), settings)


def _hint(path: Path) -> str:
    """Find the folder inside, if exactly one of them is a recording."""
    inside = [
        child
        for child in sorted(path.iterdir())
        if child.is_dir()
        and (
            (child / "mav0").is_dir()
            or (child / "metadata.yaml").is_file()
            or (child / "calib.txt").is_file()
        )
    ]
    return f"the folder inside, {inside[0]}" if len(inside) == 1 else ""
