"""Define the record of a measurement, from which the result files and the report are written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.arrays import Float32, Float64, UInt8
from barsight.core.notices import Notice
from barsight.core.pose import Pose
from barsight.core.records.heights import Agreement, Contour
from barsight.core.records.pairs import RefusedFrame
from barsight.core.records.sensor_samples import LaserProfile
from barsight.core.records.trajectory import Trajectory
from barsight.mapping.free_space import FreeSpace
from barsight.mapping.passes.changes import BundleMove, HeightChange
from barsight.mapping.surface.laser_check import LaserCheck
from barsight.mapping.surface.surface import Surface
from barsight.mapping.top_photo import TopPhoto
from barsight.registration.pass_ties import PairTie, PassCorrection
from barsight.yard.inventory.stock_list import StockMatch
from barsight.yard.lifting.targets import LiftPlan
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.types import Bundle


@dataclass(frozen=True)
class StageTime:
    """Total duration of a stage, seconds, and its number of frames (0 if it isn't done by frame)."""

    name: str
    seconds: float
    frames: int = 0


@dataclass(frozen=True)
class Refusal:
    """A frame that a stage refused."""

    stage: str
    frame: RefusedFrame

    @property
    def stamp_ns(self) -> int:
        """Return the frame's stamp."""
        return self.frame.stamp_ns


@dataclass(frozen=True, eq=False)
class Preview:
    """One rectified left picture (H, W) uint8 and its disparity (H, W) float32, for inspection."""

    left: UInt8
    disparity_px: Float32


@dataclass(frozen=True, eq=False)
class BuiltMap:
    """Map of all views. placed: reference_from_rect0 of the views used, stamps_ns: their stamps. preview: of
    a view near the middle.
    """

    surface: Surface
    free: FreeSpace
    tops: TopPhoto
    placed: tuple[Pose, ...]
    stamps_ns: tuple[int, ...]
    refusals: tuple[Refusal, ...]
    preview: Preview | None


@dataclass(frozen=True, eq=False)
class PassRecord:
    """One of several passes, the oldest first. captured_ns: stamps of its first and last measured frame.

    first_ns, last_ns: of its part of the trajectory. ties: with earlier passes; changes, moves: seen by it.
    """

    recording_path: Path
    recording_format: str
    input_hashes: dict[str, str]
    length_m: float
    captured_ns: tuple[int, int] | None
    first_ns: int
    last_ns: int
    frames_used: int
    frames_total: int
    correction: PassCorrection
    ties: tuple[PairTie, ...]
    changes: tuple[HeightChange, ...]
    moves: tuple[BundleMove, ...]


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measured recording; `surface` reads its tiles from a scratch folder that must still exist.

    rig_covariance: of yaw (rad), baseline and focal length (ratios) after the travel, (3, 3); None if no rig
    file states it. frames_passed_over: number of located frames whose picture had hardly moved. seconds:
    wall-clock time; the stages' own seconds overlap. yard_frame_id: digest of the mounting of the body on
    the crane; None if the map isn't in the yard's frame. frame_id: name of the frame of all coordinates.
    passes: of several recordings; the recording is then the newest. agreements: of vision alone.
    laser_checks: of the laser before it was fused; None if fusion wasn't requested.
    """

    recording_path: Path
    recording_format: str
    is_simulated: bool
    calibration_hash: str
    configuration_hash: str
    input_hashes: dict[str, str]
    configuration: dict[str, Any]
    trajectory: Trajectory
    frames_total: int
    frames_used: int
    frames_passed_over: int
    refusals: tuple[Refusal, ...]
    sensors_used: tuple[str, ...]
    surface: Surface
    contours: tuple[Contour, ...]
    laser: tuple[LaserProfile, ...]
    agreements: tuple[Agreement, ...]
    laser_checks: tuple[LaserCheck, ...] | None
    stages: tuple[StageTime, ...]
    warnings: tuple[Notice, ...]
    seconds: float
    peak_memory_mib: float
    preview: Preview | None
    bundles: tuple[Bundle, ...]
    lifts: LiftPlan
    stock: StockMatch | None
    travel: Travel
    rig_covariance: Float64 | None
    yard_frame_id: str | None
    frame_id: str
    passes: tuple[PassRecord, ...] = ()
