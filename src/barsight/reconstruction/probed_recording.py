"""Inspect a recording before it is measured: distance, cell size, calibration, doubts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.calibration.geometry.rectification import Rectifier
from barsight.calibration.stereo.disparity_uncertainty import disparity_sigma_px
from barsight.core.errors import InputError
from barsight.core.json_values import json_value
from barsight.core.notices import Notice
from barsight.core.timing import Stopwatch
from barsight.mapping.recording_probe import (
    RecordingProbe,
    choose_cell_size,
    points_per_pixel,
    probe_recording,
)
from barsight.measure_settings import MeasureSettings
from barsight.reconstruction.checkpoint import checkpoint_folder, checkpoint_key, checkpointed
from barsight.recording.base import Recording
from barsight.recording.plausibility import clock_faults, doubts, mosaics
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.recording.sensor_selection import SelectedSensors
from barsight.yard_frame import in_yard


@dataclass(frozen=True, eq=False)
class ProbedRecording:
    """Result of inspecting a recording. calibration_px: sigma of the disparity due to the calibration.
    doubts: implausible samples and pictures. inputs: SHA-256 of the files. checkpoints: their folder, if any.
    watch: times the stages.
    """

    source: Recording
    pairs: RectifiedPairs
    first: RecordingProbe
    cell_m: float
    calibration_px: float
    doubts: tuple[Notice, ...]
    configuration: dict[str, Any]
    inputs: dict[str, str]
    checkpoints: Path | None
    watch: Stopwatch

    @property
    def per_pixel(self) -> int:
        """Return the number of points along each axis of a pixel that the cells need."""
        return points_per_pixel(self.first, self.cell_m)

    @property
    def frames_total(self) -> int:
        """Return the number of recorded frames, including those without a partner."""
        return len(self.source.index.stamps_ns) + len(self.source.index.unpaired)


def inspect_recording(
    recording: Recording, settings: MeasureSettings, scratch: Path, resume: Path | None
) -> ProbedRecording:
    """Inspect a recording: measure the distance of the scene, choose the cell size and estimate the
    calibration's uncertainty.

    Raises InputError where the sensors' clocks differ.
    """
    source: Recording = SelectedSensors(recording, settings.use)
    source, watch = in_yard(source, settings.yard), Stopwatch()
    if faults := clock_faults(source):
        raise InputError(source.path, "; ".join(faults), "or leave the sensor out of use")
    configuration, inputs = json_value(settings), source.digests()
    checkpoints = None
    if resume is not None:
        checkpoints = checkpoint_folder(resume, checkpoint_key(recording, source, settings, inputs))
    with watch("look"):
        pairs = RectifiedPairs(source, Rectifier(source.rig), checkpoints or scratch, watch)
        first, cell_m, calibration_px = look_at(pairs, settings, checkpoints)
    return ProbedRecording(
        source, pairs, first, cell_m, calibration_px, (*doubts(source), *mosaics(source)), configuration,
        inputs, checkpoints, watch,
    )  # fmt: skip


def look_at(
    pairs: RectifiedPairs, settings: MeasureSettings, checkpoints: Path | None
) -> tuple[RecordingProbe, float, float]:
    """Probe the first usable pair; return its result, the side of the map's cells (m) and the sigma of the
    disparity due to the calibration (px).
    """
    first = checkpointed(checkpoints, "look", lambda: probe_recording(pairs))
    has_crane = pairs.recording.crane() is not None
    cell_m = settings.map.cell_m or choose_cell_size(first, has_crane=has_crane)
    known_px = disparity_sigma_px(settings.recording.rig, first.range_m)
    return first, cell_m, settings.stereo.calibration_sigma_px if known_px is None else known_px
