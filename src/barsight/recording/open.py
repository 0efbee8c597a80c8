"""One door for every format: `open_recording` looks at what lies at a path and takes the right reader."""

from __future__ import annotations

from pathlib import Path

from barsight.core.errors import InputError
from barsight.recording.base import RecordingSettings
from barsight.recording.euroc import EurocRecording
from barsight.recording.kitti import KittiRecording, is_kitti
from barsight.recording.stored import Source

KNOWN = (
    "an EuRoC folder (holding mav0), a KITTI odometry sequence (calib.txt, image_0, image_1), a ROS 1 .bag, "
    "a ROS 2 bag folder (metadata.yaml), a .mcap or a .db3"
)


def open_recording(path: Path, settings: RecordingSettings | None = None) -> Source:
    """The recording at `path`, of whichever format; calibration and the lists of pictures are checked.

    Raises `InputError` for no such folder or an unknown format, and what the readers raise.
    """
    settings = settings or RecordingSettings()
    if not path.exists():
        raise InputError(path, "no such file or folder", "check the path")
    if path.is_dir() and ((path / "mav0").is_dir() or (path / "cam0").is_dir() or (path / "cam1").is_dir()):
        return EurocRecording(path, settings)
    if path.is_dir() and is_kitti(path):
        return KittiRecording(path, settings)
    raise InputError(path, "is no recording that Barsight knows", f"give {KNOWN}")
