"""Read KITTI's odometry recordings: rectified pairs, a `calib.txt`, no IMU. The body is the left camera.

The standard layout has `P0:` ... `P3:` in calib.txt, `image_0`, `image_1` (gray; else `image_2`, `image_3`)
and `times.txt`. A second layout has two bare lines of twelve numbers, `image_l`, `image_r` and no times.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from barsight.calibration.files.euroc import build_rig
from barsight.calibration.files.rig_formats import select_rig
from barsight.calibration.files.yaml_document import canonical_pose
from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64, Int64
from barsight.core.errors import CalibrationError, InputError
from barsight.core.reading.bounded_reading import (
    MAX_PICTURES,
    MAX_SETTINGS_BYTES,
    in_range,
    read_lines,
    read_text,
)
from barsight.core.records.gray_levels import TornImageError
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.core.stamps import NS_PER_S, expect_increasing, seconds_in_ns
from barsight.recording.base import RecordingSettings
from barsight.recording.formats.image_folders import PictureFiles
from barsight.recording.image_decoding import decode_gray
from barsight.recording.own_files import expect_own_files, file_digests, read_picture
from barsight.recording.pairing import pair_cameras

FOLDERS = (
    ("image_0", "image_1", "P0", "P1"),
    ("image_2", "image_3", "P2", "P3"),
    ("image_l", "image_r", "", ""),
)
TABLES = ("calib.txt", "times.txt")
ASSUMED_RATE_HZ = 10
ORIGINAL = "take the sequence's own calib.txt"
PICTURE = re.compile(r"([0-9]{1,12})\.(png|jpg|jpeg)$", re.IGNORECASE)


def is_kitti(path: Path) -> bool:
    """Check whether a folder looks like a KITTI odometry sequence."""
    return (path / "calib.txt").is_file() or any((path / names[0]).is_dir() for names in FOLDERS)


class KittiRecording(PictureFiles):
    """A `Recording` in KITTI's layout. `poses.txt` is never read here."""

    format = "kitti"
    is_simulated = False

    def __init__(self, path: Path, settings: RecordingSettings) -> None:
        self.path = path
        expect_own_files(path, TABLES)
        layout = next((names for names in FOLDERS if (path / names[0]).is_dir()), None)
        if layout is None:
            raise InputError(
                path, "has a calib.txt but no folder image_0, image_2 or image_l", "add the pictures"
            )
        left_name, right_name, *keys = layout
        if not (path / right_name).is_dir():
            raise InputError(
                path, f"has {left_name} but no {right_name}", "a stereo recording needs both cameras"
            )
        left, right = _pictures(path / left_name), _pictures(path / right_name)
        times = _read_times(path / "times.txt")
        self.notes: tuple[str, ...] = ()
        if times is None:
            self.notes = (f"no times.txt: {ASSUMED_RATE_HZ} pictures per second are assumed",)
        self._left, self._right = list(left.values()), list(right.values())
        self._root = path
        self._pairs = pair_cameras(
            path, _stamps(path, left, times), _stamps(path, right, times), settings.pair_tolerance_s
        )
        projections = _read_projections(path / "calib.txt", (keys[0], keys[1]))
        own = _rig(path / "calib.txt", projections, (_size(self._left), _size(self._right)))
        self.rig = select_rig(settings.rig, own)

    def imu(self) -> ImuSamples | None:
        """Return None: KITTI's odometry recordings have no IMU."""
        return None

    def imu_noise(self) -> ImuNoise | None:
        """Return None: there is no IMU."""
        return None

    def crane(self) -> CraneSamples | None:
        """Return None: there is no crane."""
        return None

    def laser(self) -> tuple[LaserProfile, ...]:
        """Return nothing: there is no laser."""
        return ()

    def digests(self) -> dict[str, str]:
        """Compute digests; see `Recording.digests`."""
        return file_digests(self.path, [self.path / name for name in TABLES])


def _pictures(folder: Path) -> dict[int, Path]:
    """List the pictures in the order of their numbers."""
    found = {
        int(match[1]): path for path in folder.iterdir() if (match := PICTURE.match(path.name)) is not None
    }
    if not found:
        raise InputError(folder, "holds no pictures named 000000.png and so on", "add the pictures")
    return dict(sorted(found.items()))


def _read_times(path: Path) -> Int64 | None:
    """Read stamps (N,) ns; exact although the file writes `1.036224e-01`."""
    if not path.is_file():
        return None
    stamps = []
    for number, text in enumerate(read_lines(path, MAX_PICTURES), 1):
        if text.strip():
            try:
                stamps.append(seconds_in_ns(text.strip()))
            except ValueError:
                raise InputError(
                    path, f"line {number}: {text.strip()[:40]!r} is not a time in seconds", "mend the line"
                ) from None
    if not stamps:
        raise InputError(path, "has no rows", "remove the file to assume 10 pictures per second")
    stamp_ns = np.array(stamps, dtype=np.int64)
    expect_increasing(stamp_ns, path, 1)
    return stamp_ns


def _stamps(root: Path, pictures: dict[int, Path], times: Int64 | None) -> Int64:
    numbers = np.array(list(pictures), dtype=np.int64)
    if times is None:
        return numbers * (NS_PER_S // ASSUMED_RATE_HZ)
    if numbers[-1] >= times.size:
        raise InputError(
            root / "times.txt",
            f"has {times.size} lines, but there is a picture {pictures[int(numbers[-1])].name}",
            "take the times.txt of this sequence",
        )
    return times[numbers]


def _read_projections(path: Path, keys: tuple[str, str]) -> tuple[Float64, Float64]:
    """Read two (3, 4) matrices. Bare lines are the left and the right one in this order."""
    if not path.is_file():
        raise CalibrationError(path, "no such file", "copy the sequence's calib.txt beside its pictures")
    named: dict[str, Float64] = {}
    bare: list[Float64] = []
    for number, text in enumerate(read_text(path, MAX_SETTINGS_BYTES).split("\n"), 1):
        name, colon, rest = text.partition(":")
        name, rest = (name.strip(), rest) if colon else ("", text)
        if not rest.strip() or (name and name not in keys):
            continue
        try:
            values = np.array([float(field) for field in rest.split()])
        except ValueError:
            raise CalibrationError(
                path, f"line {number}: holds something that is not a number", "mend it"
            ) from None
        if values.size != 12 or not in_range(values).all():
            raise CalibrationError(
                path, f"line {number}: expected 12 numbers in range, a 3x4 matrix", "mend it"
            )
        if name:
            named[name] = values.reshape(3, 4)
        else:
            bare.append(values.reshape(3, 4))
    if all(keys) and all(key in named for key in keys):
        return named[keys[0]], named[keys[1]]
    if len(bare) == 2:
        return bare[0], bare[1]
    wanted = f"lines `{keys[0]}:` and `{keys[1]}:`" if all(keys) else "two lines of twelve numbers"
    raise CalibrationError(path, f"has no {wanted}", ORIGINAL)


def _rig(path: Path, projections: tuple[Float64, Float64], sizes: tuple[tuple[int, int], ...]) -> StereoRig:
    cameras, places = [], []
    for p, (width, height) in zip(projections, sizes, strict=True):
        try:
            cameras.append(
                Camera(width, height, float(p[0, 0]), float(p[1, 1]), float(p[0, 2]), float(p[1, 2]))
            )
        except ValueError as error:
            raise CalibrationError(path, str(error), ORIGINAL) from None
        # P = K [I | t]: t is the position of the reference camera's origin in this camera's frame.
        along_z = p[2, 3]
        places.append(
            [(p[0, 3] - p[0, 2] * along_z) / p[0, 0], (p[1, 3] - p[1, 2] * along_z) / p[1, 1], along_z]
        )
    cam1_in_cam0 = np.eye(4)
    cam1_in_cam0[:3, 3] = np.array(places[0]) - np.array(places[1])
    if not in_range(cam1_in_cam0).all():
        raise CalibrationError(path, "its matrices put the cameras impossibly far apart", ORIGINAL)
    left = canonical_pose("body", "cam0", np.eye(4))
    right = canonical_pose("body", "cam1", cam1_in_cam0)
    return build_rig(path, cameras[0], cameras[1], left, right, 0)


def _size(paths: list[Path]) -> tuple[int, int]:
    """Read (width, height) of the first intact picture, as KITTI's calibration does not state it."""
    for path in paths:
        try:
            height, width = decode_gray(read_picture(path, path.parents[1])).shape
        except (FileNotFoundError, TornImageError):
            continue
        return width, height
    raise InputError(paths[0].parent, "holds no whole picture", "copy the recording again")
