"""Inputs that contradict each other: refused or vetoed by a name, and nothing sound is."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import BarsightError, InputError
from barsight.core.notices import FORBIDS, WARNINGS
from barsight.core.records.sensor_samples import ImuSamples
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.motion.batch.sensor_agreement import refuse_contradictions
from barsight.motion.settings import MotionSettings, make_estimator
from barsight.recording.open import open_recording
from barsight.recording.plausibility import clock_faults, doubts
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import simulate
from barsight.yard.magnet.description import example_magnet
from barsight.yard.vetoes import VETOES
from contradicting_inputs import AGES, CONTRADICTIONS
from drawn_steps import DrawnSteps, drawn_steps
from simulated_ways import steady


def refusal(steps: DrawnSteps) -> str:
    """Return the reason of a refusal; nothing where it isn't."""
    try:
        refuse_contradictions(Path("way"), steps.sightings, steps.imu, steps.crane, steps.rectifier, 0)
    except InputError as error:
        return str(error)
    return ""


def places(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[DrawnSteps], DrawnSteps]:
    return lambda s: replace(s, crane=replace(s.crane, position_m=change(s.crane.position_m)))


def turns(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[DrawnSteps], DrawnSteps]:
    return lambda s: replace(s, imu=replace(s.imu, gyro_radps=change(s.imu.gyro_radps)))


def late(sensor: str, seconds: float) -> Callable[[DrawnSteps], DrawnSteps]:
    def change(steps: DrawnSteps) -> DrawnSteps:
        samples = getattr(steps, sensor)
        return replace(steps, **{sensor: replace(samples, stamp_ns=samples.stamp_ns + round(1e9 * seconds))})

    return change


def heading(degrees: float) -> Callable[[DrawnSteps], DrawnSteps]:
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return lambda s: replace(
        s, crane=replace(s.crane, yard_from_body_nominal=turn @ s.crane.yard_from_body_nominal)
    )


WRONG_STEPS: dict[str, tuple[Callable[[DrawnSteps], DrawnSteps], str]] = {
    "encoders in mm": (places(lambda p: 1e3 * p), "wrong unit"),
    "encoders in km": (places(lambda p: 1e-3 * p), "wrong unit"),
    "encoders in feet": (places(lambda p: 3.2808 * p), "wrong unit"),
    "encoders negated": (places(lambda p: -p), "wrong mounting"),
    "bridge and trolley exchanged": (places(lambda p: p[:, [1, 0, 2]]), "wrong mounting"),
    "heading 10 degrees off": (heading(10), "wrong mounting"),
    "gyro in degrees/s": (turns(lambda w: np.degrees(w)), "wrong unit"),
    "gyro divided by 57": (turns(lambda w: np.radians(w)), "wrong unit"),
    "gyro negated": (turns(lambda w: -w), "wrong mounting"),
    "crane clock 0.5 s late": (late("crane", 0.5), "wrong clock"),
    "crane clock 0.5 s early": (late("crane", -0.5), "wrong clock"),
    "IMU clock 0.5 s late": (late("imu", 0.5), "wrong"),
}


def judged(seeds: range, spoil: Callable[[DrawnSteps], DrawnSteps] = lambda steps: steps) -> list[str]:
    return [refusal(spoil(drawn_steps(seed))) for seed in seeds]


def test_no_drawn_way_is_refused_and_what_is_wrong_is() -> None:
    assert judged(range(100, 120)) == [""] * 20
    for name in ("encoders in mm", "gyro in degrees/s", "crane clock 0.5 s late"):
        spoil, words = WRONG_STEPS[name]
        assert sum(words in told for told in judged(range(100, 106), spoil)) >= 5


@pytest.mark.parametrize("seed", [20026, 20000])
def test_a_trolley_that_counts_backwards_in_few_steps_is_refused(seed: int) -> None:
    """It travelled 1.9 m while the bridge travelled 40: most steps' directions hid it."""
    told = refusal(places(lambda place: place * [1, -1, 1])(drawn_steps(seed)))
    assert "wrong mounting" in told and "sign" in told


@pytest.mark.parametrize("name", ["fused", "live", "crane"])
def test_an_accelerometer_in_g_is_refused_where_no_file_is_read(
    name: Literal["fused", "live", "crane"],
) -> None:
    recording, *_ = steady(0.5, 0)
    assert recording.imu_samples is not None
    imu = replace(recording.imu_samples, accel_mps2=recording.imu_samples.accel_mps2 / 9.80665)
    estimator = make_estimator(MotionSettings(name))
    with pytest.raises(InputError, match="probably in g"):
        estimator.begin(replace(recording, imu_samples=imu), Rectifier(recording.rig))


@pytest.mark.parametrize("axes", [[0, 1, 2], [0]])
def test_encoders_that_freeze_have_no_wrong_unit_or_mounting(axes: list[int]) -> None:
    def frozen(place: np.ndarray) -> np.ndarray:
        begin, held = len(place) // 5, place.copy()
        held[begin : 2 * begin + begin // 2, axes] = place[begin, axes]
        return held

    assert judged(range(100, 110), places(frozen)) == [""] * 10
    told = judged(range(100, 106), places(lambda place: 1000 * frozen(place)))
    assert sum("wrong unit" in one for one in told) >= 5


def test_a_gap_of_the_imu_is_no_wrong_mounting() -> None:
    """Over 6 s without readings nothing is known of the body's turn."""

    def change(steps: DrawnSteps) -> DrawnSteps:
        time_s = (steps.imu.stamp_ns - steps.imu.stamp_ns[0]) / 1e9
        kept = np.abs(time_s - 0.4 * time_s[-1] - 3) > 3
        return replace(steps, imu=ImuSamples(*(values[kept] for values in vars(steps.imu).values())))

    assert judged(range(100, 130), change) == [""] * 30


@pytest.mark.slow
def test_a_hundred_drawn_ways() -> None:
    seeds = range(20000, 20100)
    false = [told for told in judged(seeds) if told]
    print(f"sound ways refused: {len(false)} of {len(seeds)} {false}")
    assert len(false) <= 1
    for name, (spoil, words) in WRONG_STEPS.items():
        told = judged(seeds, spoil)
        named, caught = sum(words in one for one in told), sum(bool(one) for one in told)
        print(f"{name}: {caught} refused, {named} by name, of {len(seeds)}")
        assert caught >= 0.85 * len(seeds)


def test_every_code_that_forbids_is_a_veto() -> None:
    assert set(FORBIDS) <= set(WARNINGS) and set(FORBIDS.values()) <= set(VETOES)


@pytest.mark.parametrize(
    "name", ["yard_dev", "yard_thin", "yard_pile", "kitti_odometry_a", "euroc_v101_still"]
)
def test_sound_recordings_are_not_doubted(name: str, data: Path) -> None:
    recording = open_recording(data / name)
    assert clock_faults(recording) == () and doubts(recording) == ()


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "recording"
    simulate(path, SimulationSettings.demo())
    return path


def outcome(
    recording: Path, judged_at: Literal["now", "end"] = "end", *, has_magnet: bool = True
) -> tuple[str, int]:
    """The refusal or the map's vetoes, and how many lifts are offered."""
    magnet = recording.parent / "magnet.toml"
    magnet.write_text(example_magnet())
    out = recording.parent / "out"
    given = magnet if has_magnet else None
    try:
        measure_into(
            recording, out, MeasureSettings(), advance=lambda *_: None, magnet=given, judged_at=judged_at
        )
    except BarsightError as error:
        return str(error), 0
    lifts = json.loads((out / "lifts.json").read_text())
    return "; ".join(f"{veto['code']}: {veto['reason']}" for veto in lifts["vetoes"]), len(lifts["lifts"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nothing", *CONTRADICTIONS])
def test_a_spoiled_recording_offers_nothing_and_says_why(name: str, sound: Path, tmp_path: Path) -> None:
    recording = Path(shutil.copytree(sound, tmp_path / "recording"))
    if name == "nothing":
        told, offered = outcome(recording)
        assert told == "" and offered > 0
        return
    spoil, words = CONTRADICTIONS[name]
    spoil(recording / "mav0")
    told, offered = outcome(recording)
    assert offered == 0 and words in told and "\n" not in told


@pytest.mark.slow
@pytest.mark.parametrize("name", AGES)
def test_what_is_stale_future_or_missing_offers_nothing(name: str, sound: Path, tmp_path: Path) -> None:
    recording = Path(shutil.copytree(sound, tmp_path / "recording"))
    spoil, has_magnet, code = AGES[name]
    spoil(recording / "mav0")
    told, offered = outcome(recording, "now", has_magnet=has_magnet)
    assert offered == 0 and code in told
