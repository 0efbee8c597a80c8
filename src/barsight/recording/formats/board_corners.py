"""Read recordings of a board's corners instead of pictures: `camN_detections.npz` and `imu0.csv`.

Each corner is identified, so the motion can be estimated from them; nothing can be mapped.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from barsight.calibration.boards.detection_files import NAMES, read_rows
from barsight.calibration.files.kalibr import read_imu_file
from barsight.calibration.files.rig_formats import read_rig_file
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.errors import InputError
from barsight.core.records.pairs import NamedPoints, RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.recording.base import RecordingSettings
from barsight.recording.formats.imu_log import read_imu_log
from barsight.recording.own_files import expect_own_files, file_digests
from barsight.recording.pairing import PairedAtOpening, pair_cameras
from barsight.recording.stored_images import StoredImage

FIELDS = ("stamp_ns", "tag", "corner", "u", "v")
FILES = (*NAMES, "imu0.csv")
CORNERS_A_TAG = 4
NO_PICTURES = "corners were recorded, no pictures"


class CornerRecording(PairedAtOpening):
    """A `Recording` that has `points` instead of pictures: every frame is refused as a picture.

    The folder contains no camera calibration: the settings must name a rig. Raises `InputError` and
    `CalibrationError`.
    """

    format = "corners"
    is_simulated = False

    def __init__(self, path: Path, settings: RecordingSettings) -> None:
        if settings.rig is None:
            raise InputError(path, "holds corners without a calibration", "name its rig file (rig)")
        self.path = path
        expect_own_files(path, FILES)
        self.rig: StereoRig = read_rig_file(settings.rig)
        self._imu_yaml = settings.imu_yaml
        self._rows = [read_rows(path / name, FIELDS) for name in NAMES]
        for name, rows in zip(NAMES, self._rows, strict=True):
            if rows.size == 0:
                raise InputError(path / name, "has no rows", "detect the corners again")
        left, right = (np.unique(rows["stamp_ns"]).astype(np.int64) for rows in self._rows)
        self._pairs = pair_cameras(path, left, right, settings.pair_tolerance_s)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes; see `Recording.notes`."""
        imu = self._imu
        return () if imu is None else imu.notes

    def points(self) -> Iterator[NamedPoints]:
        """Yield the points that both cameras see at each of the index's stamps."""
        pairing = self._pairs.pairing
        seen = [_by_stamp(rows) for rows in self._rows]
        for left, right in zip(pairing.left, pairing.right, strict=True):
            names, pixels = seen[0][int(self._pairs.left_ns[left])]
            other_names, other_pixels = seen[1][int(self._pairs.right_ns[right])]
            both, first, second = np.intersect1d(names, other_names, return_indices=True)
            yield NamedPoints(int(self._pairs.left_ns[left]), both, pixels[first], other_pixels[second])

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        """Refuse all frames: there are no pictures."""
        for stamp in self.index.stamps_ns:
            if wanted is None or stamp in wanted:
                yield RefusedFrame(stamp, NO_PICTURES)

    def stored_images(self) -> Iterator[StoredImage]:
        """Raise InputError: there are no pictures."""
        raise InputError(self.path, NO_PICTURES, "give a recording with pictures")

    @cached_property
    def _imu(self) -> Any:
        path = self.path / "imu0.csv"
        return read_imu_log(path) if path.is_file() else None

    def imu(self) -> ImuSamples | None:
        """Read the IMU; see `Recording.imu`."""
        log = self._imu
        return None if log is None else log.samples

    def imu_noise(self) -> ImuNoise | None:
        """Read the settings' imu.yaml, as the folder has none."""
        return None if self._imu_yaml is None else read_imu_file(self._imu_yaml).noise

    def crane(self) -> CraneSamples | None:
        """Return None: there is no crane."""
        return None

    def laser(self) -> tuple[LaserProfile, ...]:
        """Return nothing: there is no laser."""
        return ()

    def digests(self) -> dict[str, str]:
        """Compute digests; see `Recording.digests`."""
        return file_digests(self.path, [self.path / name for name in FILES])


def _by_stamp(rows: Any) -> dict[int, tuple[Any, Any]]:
    """Group names (N,) and pixels (N, 2) by stamp."""
    order = np.argsort(rows["stamp_ns"], kind="stable")
    stamps, first = np.unique(rows["stamp_ns"][order], return_index=True)
    names = rows["tag"].astype(np.int64) * CORNERS_A_TAG + rows["corner"]
    pixels = np.column_stack([rows["u"], rows["v"]]).astype(np.float64)
    parts = np.split(order, first[1:])
    return {int(stamp): (names[part], pixels[part]) for stamp, part in zip(stamps, parts, strict=True)}
