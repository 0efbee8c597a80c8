"""Read recordings in EuRoC's (ASL's) folder layout, with crane and laser."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from barsight.calibration.files.euroc import read_imu, read_rig
from barsight.calibration.files.rig_formats import select_rig
from barsight.calibration.files.yaml_document import read_document
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.errors import InputError
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.recording.base import RecordingSettings
from barsight.recording.formats.euroc_tables import Table, read_image_list, read_table
from barsight.recording.formats.image_folders import PictureFiles
from barsight.recording.own_files import expect_own_files, file_digests, states_simulated
from barsight.recording.pairing import pair_cameras
from barsight.recording.sensor_samples import laser_std, make_crane, make_imu, make_laser

IMU_COLUMNS = ("timestamp", "w_x", "w_y", "w_z", "a_x", "a_y", "a_z")
CRANE_COLUMNS = ("timestamp", "bridge_x", "trolley_y", "hoist_z")
LASER_COLUMNS = ("profile", "x", "y", "z")
SENSORS = ("cam0", "cam1", "imu0", "crane0", "laser0")
FILES = ("body.yaml", *(f"{sensor}/{name}" for sensor in SENSORS for name in ("data.csv", "sensor.yaml")))
"""All files that are read, except pictures."""


class EurocRecording(PictureFiles):
    """A `Recording` in a folder `mav0`. Opening checks the calibration and both lists of pictures.

    `state_groundtruth_estimate0` is never read here. Raises `InputError` and `CalibrationError`.
    """

    format = "euroc"

    def __init__(self, path: Path, settings: RecordingSettings) -> None:
        self.path = path
        self._root = path / "mav0" if (path / "mav0").is_dir() else path
        expect_own_files(path, ["mav0"])
        expect_own_files(self._root, FILES)
        for camera in ("cam0", "cam1"):
            if not (self._root / camera).is_dir():
                raise InputError(
                    self._root, f"has no folder {camera}", "a stereo recording needs both cam0 and cam1"
                )
        self.rig: StereoRig = select_rig(settings.rig, read_rig(self._root))
        left_ns, left_names = read_image_list(self._root / "cam0" / "data.csv")
        right_ns, right_names = read_image_list(self._root / "cam1" / "data.csv")
        self._left = self._image_paths("cam0", left_names)
        self._right = self._image_paths("cam1", right_names)
        self._pairs = pair_cameras(self._root, left_ns, right_ns, settings.pair_tolerance_s)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes; see `Recording.notes`."""
        mount = self._imu_file("sensor.yaml")
        if mount and read_imu(mount).body_from_imu.translation.any():
            return ("the IMU sits away from the body's origin: its lever arm is neglected",)
        return ()

    @cached_property
    def is_simulated(self) -> bool:
        """Return `is_simulated` of `body.yaml`; False if it isn't stated."""
        return states_simulated(self._root)

    @cached_property
    def _imu(self) -> ImuSamples | None:
        path = self._imu_file("data.csv")
        if path is None:
            return None
        table = _stamped(path, IMU_COLUMNS)
        mount = read_imu(self._root / "imu0" / "sensor.yaml").body_from_imu
        return make_imu(path, table.first, table.rest[:, :3], table.rest[:, 3:], mount)

    def imu(self) -> ImuSamples | None:
        """Read the IMU; see `Recording.imu`."""
        return self._imu

    def imu_noise(self) -> ImuNoise | None:
        """Read the IMU's noise; see `Recording.imu_noise`."""
        path = self._imu_file("sensor.yaml")
        return read_imu(path).noise if path else None

    def crane(self) -> CraneSamples | None:
        """Read the encoders; see `Recording.crane`."""
        return self._crane

    @cached_property
    def _crane(self) -> CraneSamples | None:
        folder = self._root / "crane0"
        if not folder.is_dir():
            return None
        table = _stamped(folder / "data.csv", CRANE_COLUMNS)
        return make_crane(read_document(folder / "sensor.yaml"), table.first, table.rest)

    def laser(self) -> tuple[LaserProfile, ...]:
        """Read the laser; see `Recording.laser`."""
        folder = self._root / "laser0"
        if not folder.is_dir():
            return ()
        table = read_table(folder / "data.csv", LASER_COLUMNS)
        table.expect_finite("remove the laser's dropouts from the file")
        description = folder / "sensor.yaml"
        std = laser_std(read_document(description) if description.is_file() else None)
        return make_laser(folder / "data.csv", table.first, table.rest, std)

    def digests(self) -> dict[str, str]:
        """Compute digests; see `Recording.digests`."""
        return file_digests(self._root, [self._root / name for name in FILES])

    def _imu_file(self, name: str) -> Path | None:
        folder = self._root / "imu0"
        return folder / name if folder.is_dir() else None

    def _image_paths(self, camera: str, names: tuple[str, ...]) -> list[Path]:
        folder = self._root / camera / "data"
        paths = [folder / name for name in names]
        if not any(path.is_file() for path in paths):
            raise InputError(
                folder,
                f"not one of the {len(paths)} pictures named in {camera}/data.csv is there",
                "copy the recording again, with its pictures",
            )
        return paths


def _stamped(path: Path, columns: tuple[str, ...]) -> Table:
    table = read_table(path, columns)
    table.expect_finite("remove the line or mend its values")
    table.expect_increasing()
    return table
