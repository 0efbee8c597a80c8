"""Run what the page shows: render the recordings, and measure them by the paper's method and by ours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from barsight.benchmarks.stereo.target_size import RANGES_MM, TargetSizeBench, bench_target_size
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import BarsightError
from barsight.core.records.trajectory import Trajectory
from barsight.core.timing import ProgressCallback
from barsight.mapping.settings import MapSettings
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.motion.batch.fusion import FusionSettings
from barsight.motion.settings import MotionSettings, make_estimator
from barsight.paper.cloud import DriftRow, drift_row
from barsight.recording.base import Recording
from barsight.recording.sensor_selection import SelectedSensors
from barsight.simulation.effects.settings import FaultSettings, LightSettings
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.simulate import simulate
from barsight.stereo.method import StereoMethod
from barsight.stereo.settings import MethodName, StereoSettings, make_method

SEED = 11
BARS = "90mm:7,40mm:37,60mm:19"
METHODS: tuple[MethodName, ...] = ("sgbm", "csca", "paper", "barsight")
PAPER = MeasureSettings(
    stereo=StereoSettings(method="paper"),
    motion=MotionSettings(estimator="paper"),
    map=MapSettings(contours="paper"),
)
"""The paper's method; it takes only the first frame's position from the crane."""
OURS = MeasureSettings()
ENVIRONMENTS: dict[str, tuple[LightSettings, FaultSettings]] = {
    "dim lamps": (LightSettings(lamp_ratio=0.25, ambient=0.08), FaultSettings()),
    "haze": (LightSettings(), FaultSettings(haze_ratio=0.5)),
    "blur of motion": (LightSettings(), FaultSettings(exposure_s=0.01)),
    "dirt and drops": (LightSettings(), FaultSettings(dirt_spots=12, drops=6)),
    "flicker": (LightSettings(), FaultSettings(flicker_ratio=0.2, exposure_step_ratio=0.2)),
    "sun": (LightSettings(sun_ratio=3.0), FaultSettings(glare_ratio=0.3)),
}
"""Degradations of the paper's scene, by name: light, and image faults."""
QUICK_ENVIRONMENTS = ("dim lamps", "haze")


@dataclass(frozen=True)
class PaperScale:
    """Amount of work of a run. size_px: image width and height; ranges_mm, poses: of Table 1."""

    length_m: float
    frames: int
    size_px: tuple[int, int]
    ranges_mm: tuple[int, ...]
    poses: int
    environments: tuple[str, ...]
    icp_steps: int

    def recording(self) -> SimulationSettings:
        """Define the recording over a stack."""
        return SimulationSettings(
            length_m=self.length_m, frames=self.frames, seed=SEED, bars=BARS, camera=self.camera(),
            yard=YardSettings(bar_length_m=5.0),
        )  # fmt: skip

    def side(self) -> SimulationSettings:
        """Define the recording of a stack's side, near and at an oblique angle."""
        camera = replace(self.camera(), above_floor_m=3.2, trolley_y_m=3.6, tilt_deg=-28.0)
        yard = YardSettings(bar_length_m=5.0, max_layers=3)
        return SimulationSettings(length_m=3.0, frames=8, seed=SEED, camera=camera, yard=yard)

    def environment(self, name: str) -> SimulationSettings:
        """Define the recording of a short stack under a degradation."""
        light, faults = ENVIRONMENTS[name] if name in ENVIRONMENTS else (LightSettings(), FaultSettings())
        camera = self.camera()
        return replace(
            self.recording(), length_m=3.0, frames=8, depth_views=0, light=light, faults=faults, camera=camera
        )

    def camera(self) -> CameraSettings:
        """Define the crane's camera at this image size."""
        width, height = self.size_px
        return CameraSettings(width_px=width, height_px=height, focal_px=1250 * width / 1280)


FULL = PaperScale(35.0, 100, (640, 512), RANGES_MM, 2, tuple(ENVIRONMENTS), 10)
QUICK = PaperScale(10.0, 25, (320, 256), (1800, 8500), 1, QUICK_ENVIRONMENTS, 4)


@dataclass(frozen=True)
class EnvironmentRow:
    """One method under one degradation: frames placed, figures of its contour, and failure or ""."""

    name: str
    method: str
    frames: str
    mae_mm: float
    coverage_pct: float
    failed: str


def draw(out: Path, settings: SimulationSettings, stage: str, advance: ProgressCallback) -> Path:
    """Render a recording and return its folder."""
    simulate(out, settings, lambda done, total: advance(stage, done, total))
    return out


def measure(
    recording: Path, out: Path, settings: MeasureSettings, *, with_truth: bool, stage: str = "",
    advance: ProgressCallback | None = None,
) -> dict[str, Any] | BarsightError:  # fmt: skip
    """Measure a recording and return the content of result.json, or the error if it can't be measured."""

    def report(part: str, done: int, total: int) -> None:
        if advance is not None:
            advance(f"{stage}: {part}", done, total)

    try:
        return measure_into(
            recording, out, settings, advance=report, truth_of=recording if with_truth else None, report=False
        )
    except BarsightError as error:
        return error


def trajectories(recording: Recording) -> tuple[Trajectory, list[DriftRow]]:
    """Estimate trajectories by the paper's stitching (stereo, IMU) and by ours, each with its drift."""
    alone, rectifier = SelectedSensors(recording, ("stereo", "imu")), Rectifier(recording.rig)
    paper = make_estimator(MotionSettings(estimator="paper"))(alone, rectifier, lambda: None)
    rows = [drift_row("paper, stereo and IMU", paper, recording)]
    uses = [("ours, stereo and IMU", "stereo,imu")]
    if recording.crane() is not None:
        uses.append(("ours, with encoders", "stereo,imu,crane"))
    for what, use in uses:
        settings = MotionSettings(fusion=FusionSettings(use=use))
        try:
            rows.append(
                drift_row(what, make_estimator(settings)(recording, rectifier, lambda: None), recording)
            )
        except BarsightError:
            rows.append(drift_row(what, Trajectory("world", (), (), ()), recording))
    return paper, rows


def environment_rows(scale: PaperScale, scratch: Path, advance: ProgressCallback) -> list[EnvironmentRow]:
    """Measure the degraded scenes by both methods."""
    rows = []
    names = ("as it is", *scale.environments)
    for number, name in enumerate(names):
        advance("environments", number, len(names))
        recording = draw(scratch / f"e{number}", scale.environment(name), f"draw {name}", advance)
        for method, settings in (("paper", PAPER), ("ours", OURS)):
            content = measure(recording, scratch / f"e{number}-{method}", settings, with_truth=True)
            rows.append(_environment_row(name, method, content))
    advance("environments", len(names), len(names))
    return rows


def _environment_row(name: str, method: str, content: dict[str, Any] | BarsightError) -> EnvironmentRow:
    nan = float("nan")
    if isinstance(content, BarsightError):
        return EnvironmentRow(name, method, "-", nan, nan, str(content).rpartition(": ")[2])
    figures = content["truth"].get("contour, smooth places", {})
    frames = f"{content['frames']['used']} of {content['frames']['total']}"
    return EnvironmentRow(
        name, method, frames, figures.get("mae_mm", nan), figures.get("coverage_pct", nan), ""
    )


def target_sizes(scale: PaperScale) -> TargetSizeBench:
    """Measure a rendered bar of 90 mm by the methods of Table 1."""
    methods: dict[str, StereoMethod] = {name: make_method(StereoSettings(method=name)) for name in METHODS}
    return bench_target_size(methods, scale.poses, scale.ranges_mm)
