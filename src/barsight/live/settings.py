"""Settings of `barsight live` in addition to those of measuring."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from barsight.calibration.files.kalibr import read_camchain, read_imu_file
from barsight.calibration.files.rig_file import read_serials
from barsight.calibration.files.rig_formats import read_rig_file
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.errors import CalibrationError, ConfigError
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.settings.file import read_settings
from barsight.core.settings.values import expect_ranges, expect_values
from barsight.measure_settings import MeasureSettings
from barsight.recording.awaited import AwaitedRecording
from barsight.sensors.settings import CamerasSettings, EncodersSettings, ImuSettings


@dataclass(frozen=True)
class LiveSettings:
    """Settings of a live run at the crane."""

    ring_pairs: int = 8
    """Number of pairs that the ring in shared memory holds: 2.6 MB each at 1280x1024."""
    keyframe_way_m: float = 0.1
    """Distance in metres that the body must have moved since the last keyframe for a pair to become one,
    which is kept; it is mapped once the picture has moved enough since the last mapped one (see
    map.min_shift: 24 px are 0.19 m at 8 m and a focal length of 1000 px).
    """
    still_pairs: int = 5
    """Number of pairs kept while the crane stands, `passed_every_s` apart: they fix its starting position."""
    passed_every_s: float = 0.2
    """Shortest interval in seconds between pairs that are kept without a pose, of those that tracking
    skips.
    """
    imu_silence_s: float = 0.2
    """Time in seconds without readings after which the IMU is considered out."""
    encoder_silence_s: float = 0.3
    """Time in seconds without readings after which the encoders are considered out."""
    camera_silence_intervals: float = 2.5
    """Time without pictures after which a camera is considered out, in picture intervals, but at least 0.3
    s.
    """
    hang_s: float = 30.0
    """Time in seconds without a heartbeat after which a process is considered hung and is restarted."""
    pose_rate_hz: float = 30.0
    """Rate in poses per second at which poses are written."""
    max_predicted_s: float = 2.0
    """Longest time in seconds that IMU and encoders extend the last pair's pose; after that no pose is
    written.
    """
    health_every_s: float = 1.0
    """Interval in seconds between updates of health.json and health.prom."""

    def __post_init__(self) -> None:
        expect_values(self, "live.")
        expect_ranges(
            self, "live.", ring_pairs=(2, 1000), keyframe_way_m=(0, 10), still_pairs=(0, 1000),
            passed_every_s=(0, 60), imu_silence_s=(0.02, 10), encoder_silence_s=(0.02, 10),
            camera_silence_intervals=(1.5, 100), hang_s=(1, 3600),
            pose_rate_hz=(0.1, 200), max_predicted_s=(0, 60), health_every_s=(0.1, 60),
        )  # fmt: skip


@dataclass(frozen=True)
class RecorderSettings:
    """Settings of the recorder at a crane, for keyframes, IMU and encoders, and the ring around alarms."""

    folder: Path | None = None
    """Folder of the recordings, with a subfolder for each run; without it, one in the output folder."""
    max_used_ratio: float = 0.85
    """Share of the disk in use above which the oldest unprotected segments of earlier recordings are
    deleted.
    """
    stop_used_ratio: float = 0.95
    """Share of the disk in use above which nothing is recorded; measuring continues."""
    segment_mib: int = 256
    """Size of a segment in MiB."""
    alarm_after_s: float = 1.0
    """Time in seconds after an alarm for which all pairs are saved, in addition to those in the ring."""

    def __post_init__(self) -> None:
        expect_values(self, "recorder.")
        expect_ranges(
            self, "recorder.", max_used_ratio=(0.05, 0.99), stop_used_ratio=(0.05, 1.0),
            segment_mib=(1, 4096), alarm_after_s=(0, 60),
        )  # fmt: skip
        if self.stop_used_ratio < self.max_used_ratio:
            raise ConfigError("recorder.stop_used_ratio must be at least recorder.max_used_ratio")


@dataclass(frozen=True)
class SurveySettings:
    """Settings of when a survey begins and ends at a crane."""

    way_m: float = 0.5
    """Distance in metres that the crane must travel for a survey to have begun, with `--surveys`."""
    stop_s: float = 5.0
    """Standstill in seconds after which a survey that has begun ends."""
    rest_s: float = 600.0
    """Interval in seconds at which a run is restarted, and its recording dropped, while the crane stands."""
    max_s: float = 3600.0
    """Longest duration of a survey in seconds, whatever the crane does; it bounds disk and memory use."""
    keep: int = 200
    """Number of survey folders kept; the oldest are deleted, except those with a file `PROTECTED`."""

    def __post_init__(self) -> None:
        expect_values(self, "survey.")
        expect_ranges(
            self, "survey.", way_m=(0.1, 100), stop_s=(0.5, 600), rest_s=(10, 86400), max_s=(10, 86400),
            keep=(1, 100_000),
        )  # fmt: skip


@dataclass(frozen=True)
class CraneConfig:
    """A crane as crane.toml describes it."""

    calibration: Path
    """Rig file of the two cameras: Barsight's, Kalibr's, OpenCV's or an EuRoC folder."""
    cameras: CamerasSettings
    imu: ImuSettings | None = None
    encoders: EncodersSettings | None = None
    recorder: RecorderSettings = RecorderSettings()
    survey: SurveySettings = SurveySettings()
    measure: MeasureSettings = field(default_factory=MeasureSettings)
    live: LiveSettings = LiveSettings()

    def __post_init__(self) -> None:
        ways = [sensor.way.partition(" at ")[0] for sensor in self.sensors().values()]
        if len(set(ways)) < len(ways):
            raise ConfigError(f"imu and encoders are both at {ways[0]}; give each its own port or device")

    def sensors(self) -> dict[str, ImuSettings | EncodersSettings]:
        """Return the settings of `imu` and `crane`, if there are any."""
        have = {"imu": self.imu, "crane": self.encoders}
        return {name: one for name, one in have.items() if one is not None}

    def rig(self) -> StereoRig:
        """Read the calibration, and check by the serial numbers that it belongs to these cameras."""
        rig = read_rig_file(self.calibration)
        calibrated, configured = read_serials(self.calibration), self.cameras.serials
        if None not in calibrated and calibrated == configured[::-1]:
            raise CalibrationError(
                self.calibration,
                f"cam0 is {calibrated[0]} and cam1 {calibrated[1]}: crane.toml exchanges them",
                "exchange the two in cameras.serials, or the cameras' places",
            )  # fmt: skip
        for number, (one, other) in enumerate(zip(calibrated, configured, strict=True)):
            if one is not None and one != other:
                raise CalibrationError(
                    self.calibration,
                    f"was made with {one} as cam{number}, crane.toml names {other}: it is of another rig",
                    "name the calibration of these two cameras",
                )  # fmt: skip
        sizes = [(camera.width, camera.height) for camera in (rig.cam0, rig.cam1)]
        if sizes[0] != sizes[1]:
            raise CalibrationError(self.calibration, "the two cameras differ in size", "use two of one kind")
        return rig

    def described(self, folder: Path) -> AwaitedRecording:
        """Return the recording that will be written to `folder`, as crane.toml describes it."""
        noise = None if self.imu is None or self.imu.noise is None else read_imu_file(self.imu.noise).noise
        return AwaitedRecording(folder, self.rig(), self._no_imu(), self._no_crane(), noise)

    def awaited(self, folder: Path) -> AwaitedRecording:
        """Return the same with the calibration as stored in `folder`, so that replays use exactly that."""
        noise = read_imu_file(folder / "imu.yaml").noise if (folder / "imu.yaml").is_file() else None
        rig = read_camchain(folder / "camchain-imucam.yaml").rig
        return AwaitedRecording(folder, rig, self._no_imu(), self._no_crane(), noise)

    def _no_imu(self) -> ImuSamples | None:
        if self.imu is None:
            return None
        return ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))

    def _no_crane(self) -> CraneSamples | None:
        if (mounted := self.encoders) is None:
            return None
        return CraneSamples(
            np.zeros(0, np.int64), np.zeros((0, 3)), np.array(mounted.p_crane_body_m),
            np.reshape(mounted.R_yard_body, (3, 3)).astype(np.float64), mounted.position_std_m,
        )  # fmt: skip


def read_crane(path: Path) -> CraneConfig:
    """Read crane.toml; paths in it are relative to it. Raises InputError or ConfigError."""
    crane = read_settings(path, CraneConfig, "docs/how-to/run-a-crane.md has an example", "config")
    at = path.absolute().parent
    recorder, imu = crane.recorder, crane.imu
    if recorder.folder is not None:
        recorder = replace(recorder, folder=at / recorder.folder)
    if imu is not None and imu.noise is not None:
        imu = replace(imu, noise=at / imu.noise)
    return replace(crane, calibration=at / crane.calibration, recorder=recorder, imu=imu)
