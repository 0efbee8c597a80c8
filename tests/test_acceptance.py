"""Acceptance: fits of artefacts, decisions, causes by real triangulation, pictures, certificates."""

import base64
import dataclasses
import json
import math
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat
from scipy.spatial.transform import Rotation

from barsight.acceptance import acceptance
from barsight.acceptance.acceptance import Acceptance, accept
from barsight.acceptance.causes import name_causes
from barsight.acceptance.certificate import (
    CommissioningStep,
    certificate_content,
    certificate_files,
    read_certificate,
    write_certificate,
)
from barsight.acceptance.fitting import FittedPlate, FittedSphere, fit_plate, fit_sphere
from barsight.acceptance.layout import Area, lay_out
from barsight.acceptance.observation import LaserAgreement, Observation, ViewGeometry, nearest_bundle
from barsight.acceptance.pictures import PictureHealth, check_pictures
from barsight.acceptance.quantities import Decision, decide, judge_all
from barsight.acceptance.uncertainty import UncertaintyPart, combine
from barsight.artefacts.plan import AcceptancePlan, Plate, Sphere, TouchDown, plan_text, read_plan
from barsight.cli.main import run
from barsight.core.arrays import Float64
from barsight.core.errors import Failed, InputError
from barsight.core.reading.sealed_json import write_sealed
from barsight.core.records.pairs import StereoFrame
from barsight.measure_folder import ignore_progress
from barsight.measure_settings import MeasureSettings
from barsight.report.signing import signature_of
from barsight.simulation.effects.faults import SpoiledLens
from barsight.simulation.effects.settings import FaultSettings
from barsight.simulation.rays import cast_rays
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.worlds.artefacts import lay_artefacts
from barsight.yard.types import HeightMap
from lift_yards import laid, record

AREA = Area((0.2, 3.8), (-1.35, 1.35), 4.5, 625.0, 0.5)
SPHERE = Sphere("ball", 1.03, 0.51, 0.4, 0.3, place_sigma_m=0.0005)
PLATE = Plate("plate", 1.0, 0.5, 0.8, (0.5, 0.4), yaw_deg=20.0)
CAMERA_M = np.array([2.0, 0.05, 4.5])


def planned() -> AcceptancePlan:
    plan = lay_out(AREA, "test yard")
    assert isinstance(plan, AcceptancePlan)
    return plan


def test_a_dummy_of_bars_that_are_too_thin_is_not_measured() -> None:
    (dummy,) = planned().dummy_bundle
    for diameter_m, code in ((0.06, "thin-bars"), (dummy.bar_diameter_m, "not-found")):
        found = nearest_bundle((), replace(dummy, bar_diameter_m=diameter_m), 0.2, 0.0072)
        assert isinstance(found, Failed) and found.code == code
        assert code == "not-found" or "8.3 pixels wide, 10 are the least" in found.reason


def height_map(z: Callable[[Float64, Float64], Float64], noise_m: float = 1e-3) -> HeightMap:
    """Draw 2 m x 1.5 m of heights in cells of 10 mm."""
    y, x = np.mgrid[0:1.5:0.01, 0:2:0.01]
    drawn = z(x, y) + np.random.default_rng(3).normal(0, noise_m, x.shape)
    ones = np.ones(x.shape, np.float32)
    return HeightMap(0, 0, 0.01, drawn.astype(np.float32), 1e-3 * ones, ones, ones.astype(np.uint8))


def with_ball(x: Float64, y: Float64) -> Float64:
    """A ball that stands 90 mm and 60 mm off its planned place, on a floor."""
    left = 0.15**2 - (x - 1.12) ** 2 - (y - 0.45) ** 2
    return np.where(left > 0, 0.41 + np.sqrt(np.maximum(left, 0)), 0.0)


def test_a_sphere_is_found_and_fitted_and_floor_is_none() -> None:
    found = fit_sphere(height_map(with_ball), SPHERE, 0.25)
    assert isinstance(found, FittedSphere)
    np.testing.assert_allclose(found.centre_m, [1.12, 0.45, 0.41], atol=3e-4)
    assert found.diameter_m == pytest.approx(0.3, abs=2e-3)
    assert found.form_m == pytest.approx(2 * 1.96e-3 * 0.85, rel=0.15)  # noise is along z, radii lean
    for floor in (0.0, 0.4, 0.55):
        level = fit_sphere(height_map(lambda x, y, z=floor: 0 * x + z), SPHERE, 0.25)  # type: ignore[misc]
        assert isinstance(level, Failed) and "ball" in level.reason
    assert isinstance(fit_sphere(height_map(with_ball), replace(SPHERE, x_m=9.0), 0.25), Failed)


def test_a_plate_is_found_and_fitted_and_a_stack_is_none() -> None:
    """The plate stands 60 mm off along its first side, is 1.2 mm higher and bent by 2 mm."""
    turn = np.radians(20)
    middle = np.array([1.0, 0.5]) + 0.06 * np.array([np.cos(turn), np.sin(turn)])

    def z(x: Float64, y: Float64) -> Float64:
        along = (x - middle[0]) * np.cos(turn) + (y - middle[1]) * np.sin(turn)
        across = (y - middle[1]) * np.cos(turn) - (x - middle[0]) * np.sin(turn)
        on = (np.abs(along) < 0.25) & (np.abs(across) < 0.2)
        return np.where(on, 0.8012 + 2e-3 * np.cos(2 * np.pi * along / 0.17), 0.0)

    found = fit_plate(height_map(z, 1e-4), PLATE, 0.2)
    assert isinstance(found, FittedPlate)
    assert found.z_m == pytest.approx(0.8012, abs=1e-4)
    assert np.linalg.norm(found.shift_m - (middle - (1.0, 0.5))) < 0.03
    assert found.flatness_m == pytest.approx(4e-3, rel=0.05) and found.tilt_deg < 0.05
    assert isinstance(fit_plate(height_map(with_ball), PLATE, 0.2), Failed)


@pytest.mark.parametrize(
    ("error", "decision"),
    [(2.9, "passed"), (-3.0, "passed"), (3.1, "not proven"), (4.9, "not proven"), (-5.1, "failed"),
     (math.nan, "not measured")],
)  # fmt: skip
def test_decisions_of_iso_14253(error: float, decision: str) -> None:
    assert decide(error, 1.0, 4.0) == decision


def test_uncertainty_by_welch_and_satterthwaite() -> None:
    whole = combine([UncertaintyPart("a", 3.0, degrees_of_freedom=9), UncertaintyPart("b", 4.0)])
    assert whole.sigma == 5.0
    assert whole.degrees_of_freedom == pytest.approx(5**4 / (3**4 / 9))
    assert whole.coverage == pytest.approx(2.0, abs=0.04) and whole.expanded == 5 * whole.coverage
    few = combine([UncertaintyPart("a", 1.0, degrees_of_freedom=4)])
    assert few.coverage == pytest.approx(2.87, abs=0.01)  # GUM, table G.2
    assert combine([]).expanded == 0.0


def off_by(yaw_deg: float = 0, baseline: float = 0, focal: float = 0) -> Callable[[Float64], Float64]:
    """Triangulate with a wrong rig what a true one sees: two cameras look straight down, baseline along X."""
    turn = Rotation.from_rotvec([0, np.radians(yaw_deg), 0]).as_matrix()

    def measured(place: Float64) -> Float64:
        seen = []
        for x in np.linspace(place[0] - 1, place[0] + 1, 9):
            centre = np.array([x, CAMERA_M[1], CAMERA_M[2]])
            local = (place - centre) * (1, -1, -1)
            left = local[:2] / local[2]
            from_right = turn.T @ (local - (0.5, 0, 0))  # cam1 has turned
            right = from_right[:2] / from_right[2]
            f = 1 + focal
            depth = 0.5 * (1 + baseline) * f / (left[0] - right[0])
            seen.append(centre + np.array([left[0] / f, left[1] / f, 1]) * depth * (1, -1, -1))
        found: Float64 = np.mean(seen, axis=0)
        return found

    return measured


def observed(
    plan: AcceptancePlan, measured: Callable[[Float64], Float64], rng: np.random.Generator
) -> Observation:
    spheres = {
        s.name: FittedSphere(
            measured(np.array([s.x_m, s.y_m, s.z_m])) + rng.normal(0, (1.4e-3, 1.4e-3, 7e-4)),
            1e-3,
            s.diameter_m,
            5e-3,
            200,
        )
        for s in plan.sphere
    }
    plates = {
        p.name: FittedPlate(
            float(measured(np.array([p.x_m, p.y_m, p.z_m]))[2] + rng.normal(0, 4e-4)), 1e-4, np.zeros(2), 0.0,
            2e-3, 900,
        )
        for p in plan.plate
    }  # fmt: skip
    view = ViewGeometry(CAMERA_M, 625.0, 0.5)
    laser = (LaserAgreement(0, 0.5, 1.2),)
    bundles = {"dummy bundle": Failed("x", "no")}
    return Observation("rec", "map", "cal", "yard", True, spheres, plates, bundles, laser, view, ())


CLEAN = (PictureHealth("cam0", 0.0, 0.03, 90.0), PictureHealth("cam1", 0.0, 0.03, 90.0))


@pytest.mark.parametrize(
    ("name", "measured", "value", "sigma"),
    [
        ("", off_by(), 0.0, 1.0),
        ("yaw between the cameras", off_by(yaw_deg=0.03), 0.03, 0.004),
        ("yaw between the cameras", off_by(yaw_deg=-0.03), -0.03, 0.004),
        ("baseline", off_by(baseline=0.005), 0.5, 0.06),
        ("focal length", off_by(focal=-0.004), -0.4, 0.06),
        ("mounting height", lambda p: p + np.array([0, 0, 0.008]), 8.0, 2.0),
        ("mounting across the bridge", lambda p: p + np.array([0, -0.008, 0]), -8.0, 2.0),
    ],
)
def test_a_cause_is_named_with_its_value(
    name: str, measured: Callable[[Float64], Float64], value: float, sigma: float
) -> None:
    """Artefacts alone tell it, without the crane's travel; the truth comes from triangulation."""
    plan = planned()
    right = 0
    for seed in range(20):
        causes = name_causes(plan, [observed(plan, measured, np.random.default_rng(seed))], [], [CLEAN])
        right += ([c.name for c in causes[:1]] or [""]) == [name]
        if causes and causes[0].name == name:
            assert causes[0].value == pytest.approx(value, abs=4 * sigma)
    assert right >= 18


def test_more_recordings_name_no_cause_of_what_the_survey_is_off() -> None:
    """The artefacts' own errors, as large as stated, are the same in all ten recordings."""
    plan, named = planned(), 0
    for seed in range(20):
        rng = np.random.default_rng((8830, seed))
        stand = [
            tuple(replace(one, z_m=one.z_m + rng.normal(0, sigma_m)) for one in kind)  # type: ignore[type-var]
            for kind, sigma_m in ((plan.plate, 5e-4), (plan.sphere, 5e-4))
        ]
        true = replace(plan, plate=stand[0], sphere=stand[1])
        seen = [observed(true, off_by(), rng) for _ in range(10)]
        named += name_causes(plan, seen, [], [CLEAN] * 10) != ()
    assert named <= 1


def test_causes_that_cannot_be_told_apart_are_named_together() -> None:
    """Two plates at one height, nothing else: each of five causes lowers both alike."""
    plan = planned()
    low = tuple(one for one in plan.plate if one.z_m < 0.1)
    plan = replace(plan, plate=low, sphere=(), sphere_bar=(), step=())
    for seed in range(5):
        seen = observed(plan, off_by(focal=-0.004), np.random.default_rng((9, seed)))
        (cause,) = name_causes(plan, [seen], [], [CLEAN])
        assert {"focal length", "baseline", "mounting height"} <= {cause.name, *cause.alike}
        assert cause.words.count(" or ") == len(cause.alike)
    seen = observed(planned(), off_by(focal=-0.004), np.random.default_rng(9))
    assert name_causes(planned(), [seen], [], [CLEAN])[0].words == "focal length"


def test_bars_that_are_short_of_cold_are_no_cause() -> None:
    plan = planned()
    free = tuple(replace(one, place_sigma_m=None) for one in plan.sphere)
    cold = replace(plan.conditions, temperature_c=-30.0, expansion_per_k=23e-6)
    longer = tuple(replace(one, length_m=one.length_m / cold.expansion) for one in plan.sphere_bar)
    plan = replace(plan, plate=(), step=(), sphere=free, sphere_bar=longer, conditions=cold)
    seen = [observed(plan, off_by(), np.random.default_rng((3, seed))) for seed in range(20)]
    assert name_causes(plan, seen, [], [CLEAN]) == ()


def test_an_artefact_that_was_moved_is_named_and_dirt_comes_first() -> None:
    plan = planned()
    seen = observed(plan, off_by(), np.random.default_rng(1))
    moved = replace(seen.spheres["monument 3"], centre_m=seen.spheres["monument 3"].centre_m + 0.03)  # type: ignore[union-attr, type-var]
    seen = replace(seen, spheres={**seen.spheres, "monument 3": moved})
    assert name_causes(plan, [seen], [], [CLEAN])[0].name == "monument 3 stands elsewhere"
    high = np.array([0, 0, 0.004])  # the whole rig: the artefact is off by what the others leave of it
    lifted = {k: replace(one, centre_m=one.centre_m + high) for k, one in seen.spheres.items()}  # type: ignore[union-attr, type-var]
    raised = {k: replace(one, z_m=one.z_m + 0.004) for k, one in seen.plates.items()}  # type: ignore[union-attr, type-var]
    (cause,) = name_causes(plan, [replace(seen, spheres=lifted, plates=raised)], [], [CLEAN])
    assert cause.name == "monument 3 stands elsewhere" and cause.value == pytest.approx(30, abs=1.5)
    dirty = (CLEAN[0], replace(CLEAN[1], dirt_pct=3.0))
    assert name_causes(plan, [seen], [], [dirty])[0].name == "dirty lens of cam1"


def test_what_was_not_found_is_not_passed_and_says_why() -> None:
    plan = planned()
    seen = observed(plan, off_by(), np.random.default_rng(2))
    judged = {q.name: q for q in judge_all(plan, [seen, seen])}
    assert judged["plate 2: height"].decision is Decision.PASSED
    assert judged["dummy bundle: lift z"].decision is Decision.NOT_MEASURED
    assert judged["dummy bundle: lift z"].reason == "no"
    assert judged["laser profile 0: equivalence"].error + judged[
        "laser profile 0: equivalence"
    ].uncertainty.expanded == pytest.approx(1.2)
    lost = replace(seen, plates={**seen.plates, "plate 2": Failed("not-found", "plate 2: gone")})
    judged = {q.name: q for q in judge_all(plan, [seen, lost])}
    assert judged["plate 2: height"].decision is Decision.NOT_MEASURED  # one recording isn't enough
    assert judged["step 1: height"].reason == "plate 2: gone"


def test_repeats_are_judged_by_their_upper_bound() -> None:
    plan = planned()
    rng = np.random.default_rng(4)
    judged = judge_all(plan, [observed(plan, off_by(), rng) for _ in range(5)])
    (repeat,) = (q for q in judged if q.group == "repeat_mm")
    assert 2.0 < repeat.error < 3.2 and 0 < repeat.uncertainty.expanded < 1  # 2 s of 1 to 1.5 mm
    assert not any(q.group == "repeat_mm" for q in judge_all(plan, [observed(plan, off_by(), rng)]))


def test_the_bound_of_the_repeatability_holds_where_whole_recordings_are_shifted() -> None:
    """A crane that is 2 mm off (1 sigma) shifts all artefacts of a recording alike: few degrees of freedom,
    however many artefacts there are.
    """
    plan = replace(planned(), dummy_bundle=())

    def repeated(recordings: int, rng: np.random.Generator) -> tuple[float, float]:
        shifts = rng.normal(0, 0.002, (recordings, 3))
        seen = [observed(plan, lambda place, off=off: place + off, rng) for off in shifts]
        (repeat,) = (q for q in judge_all(plan, seen) if q.group == "repeat_mm")
        return repeat.error, repeat.error + repeat.uncertainty.expanded

    truth = repeated(150, np.random.default_rng(8))[0]
    held = [truth <= repeated(3, np.random.default_rng((9, seed)))[1] for seed in range(60)]
    assert np.mean(held) > 0.9, "95 %"


def test_a_recording_given_twice_proves_no_repeatability(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copy of it doesn't either."""
    plan = planned()
    seen = observed(plan, off_by(), np.random.default_rng(3))
    source = SimpleNamespace(rig=None, digests=lambda: {"mav0/cam0/data.csv": "0a"})
    for name, found in (
        ("open_recording", source), ("in_yard", source), ("measure_into", None), ("observe", seen),
        ("look_at_rig", (SimpleNamespace(is_bad=False), CLEAN)), ("name_causes", ()),
    ):  # fmt: skip
        monkeypatch.setattr(acceptance, name, lambda *_, found=found, **__: found)
    settings = MeasureSettings()
    assert accept(plan, [tmp_path / "a"], settings, tmp_path, ignore_progress).quantities
    with pytest.raises(InputError, match="the same recording as"):
        accept(plan, [tmp_path / "a", tmp_path / "copy"], settings, tmp_path, ignore_progress)


def test_a_touch_down_is_held_against_what_was_touched() -> None:
    plan = planned()
    top = plan.sphere[0]
    touched = (
        TouchDown("touch 1", top.name, top.x_m, top.y_m + 0.004, top.z_m + top.diameter_m / 2),
        TouchDown("touch 2", "plate 3", 0.0, 0.0, plan.plate[2].z_m - 0.02),
    )
    seen = observed(plan, lambda place: place, np.random.default_rng(5))
    judged = {q.name: q for q in judge_all(replace(plan, touch_down=touched), [seen])}
    assert judged["touch 1: y"].error == pytest.approx(-4, abs=5)
    assert judged["touch 2: z"].error == pytest.approx(20, abs=4)
    assert judged["touch 2: z"].decision is Decision.FAILED and "touch 2: x" not in judged


def test_a_touch_down_on_a_dummy_with_an_open_end_tells_its_height_only() -> None:
    """Its middle isn't seen: the touch-down would be as far off as half of what is missing."""
    plan = planned()
    (dummy,) = plan.dummy_bundle
    place = np.array([dummy.x_m, dummy.y_m - 0.06, 0.2])
    short = replace(record(laid(0.0)), centre_m=place, top_z_m=dummy.top_z_m)
    touched = (TouchDown("touch", dummy.name, dummy.x_m, dummy.y_m, dummy.top_z_m),)
    seen = observed(plan, off_by(), np.random.default_rng(7))
    for ends_open, axes in (((False, True), "z"), ((False, False), "xyz")):
        view = replace(seen, bundles={dummy.name: replace(short, ends_open=ends_open)})
        judged = judge_all(replace(plan, touch_down=touched), [view])
        assert [q.name for q in judged if q.group == "touch_mm"] == [f"touch: {axis}" for axis in axes]


def pictures(faults: FaultSettings, seed: int) -> list[StereoFrame]:
    """A textured yard that passes by: dark and bright bars, each picture another part of it."""
    rng = np.random.default_rng(seed)
    world = np.kron(rng.uniform(60, 140, (64, 200)), np.ones((8, 8))) + rng.normal(0, 6, (512, 1600))
    lens = SpoiledLens.draw(faults, (512, 640), rng)
    still = np.zeros(2)
    frames = []
    for shift in range(0, 900, 110):
        clean = world[:, shift : shift + 640]
        spoiled = 200 * lens.spoil((clean / 200).astype(np.float32), faults, still)
        left, right = (np.clip(one, 0, 255).astype(np.uint8) for one in (clean, spoiled))
        frames.append(StereoFrame(shift, left, right))
    return frames


@pytest.mark.parametrize("seed", [1, 2])
def test_dirt_and_drops_are_told_from_the_yard(seed: int) -> None:
    clean = check_pictures(pictures(FaultSettings(), seed))
    assert not isinstance(clean, Failed) and max(one.dirt_pct for one in clean) < 0.2
    for faults in (FaultSettings(dirt_spots=15, dirt_px=16), FaultSettings(drops=12, dirt_px=16)):
        spoiled = check_pictures(pictures(faults, seed))
        assert not isinstance(spoiled, Failed)
        assert spoiled[0].dirt_pct < 0.2 and spoiled[1].dirt_pct > 1
    assert isinstance(check_pictures(pictures(FaultSettings(), seed)[:3]), Failed)


def test_simulated_artefacts_stand_where_the_plan_says() -> None:
    plan = planned()
    laid = lay_artefacts(plan, SimulationSettings(length_m=4))
    for sphere in plan.sphere:
        for lean in ((0, 0), (0.6, 0), (0, -0.7)):
            x, y = sphere.x_m + lean[0] * sphere.diameter_m / 2, sphere.y_m + lean[1] * sphere.diameter_m / 2
            way, _ = cast_rays(laid.scene, np.array([[x, y, 6.0]]), np.array([[0, 0, -1.0]]))
            top = sphere.z_m + sphere.diameter_m / 2 * np.sqrt(1 - lean[0] ** 2 - lean[1] ** 2)
            assert 6 - way[0] == pytest.approx(top, abs=1e-9)
    for plate in plan.plate:
        way, _ = cast_rays(laid.scene, np.array([[plate.x_m, plate.y_m, 6.0]]), np.array([[0, 0, -1.0]]))
        assert 6 - way[0] == pytest.approx(plate.z_m, abs=1e-9)
    (dummy,) = plan.dummy_bundle
    across = dummy.x_m + np.linspace(-0.2, 0.2, 401)
    eyes = np.column_stack([across, np.full(401, dummy.y_m), np.full(401, 6.0)])
    way, _ = cast_rays(laid.scene, eyes, np.tile([0, 0, -1.0], (401, 1)))
    assert 6 - way.min() == pytest.approx(dummy.top_z_m, abs=2e-3)


def test_a_plan_is_read_as_it_was_written(tmp_path: Path) -> None:
    (tmp_path / "plan.toml").write_text(plan_text(planned()))
    assert read_plan(tmp_path / "plan.toml") == planned()


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('name = "plate 2"', 'name = "plate 1"', "'plate 1' is there twice"),
        ('lower = "plate 1"', 'lower = "plate 9"', "names 'plate 9', which isn't among"),
        ("height_mm", "hieght_mm", "did you mean height_mm?"),
        ("diameter_m = 0.288", "diameter_m = 0.01", "diameter_m must lie in"),
        ("size_m = [0.5, 0.5]", "size_m = [0.5]", "size_m has 1 value; give 2"),
    ],
)
def test_a_bad_plan_is_one_line(
    old: str, new: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = plan_text(planned())
    assert old in text
    (tmp_path / "plan.toml").write_text(text.replace(old, new, 1))
    assert run(["accept", str(tmp_path / "plan.toml"), "nowhere", "-o", str(tmp_path / "cert")]) == 2
    said = capsys.readouterr().err
    assert reason in said and "plan.toml" in said and len(said.splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["plan.toml"]


def accepted(steps: tuple[CommissioningStep, ...] = ()) -> dict[str, object]:
    plan = planned()
    seen = observed(plan, off_by(), np.random.default_rng(6))
    found = Acceptance(plan, (seen,), judge_all(plan, [seen]), (), (CLEAN,), (), {"rec": {"a.csv": "00"}})
    return certificate_content(found, "N. N.", steps)


def test_a_certificate_is_signed_and_a_changed_one_refused(tmp_path: Path) -> None:
    key = Ed25519PrivateKey.generate()
    secret = tmp_path / "key.pem"
    secret.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    content = accepted((CommissioningStep("calibrate", "good", "ab" * 32, "2026-11-26"),))
    digest = write_certificate(content, tmp_path / "cert.html", secret, pdf=True)
    read = read_certificate(tmp_path / "cert.json")
    assert read["content_sha256"] == digest and read["signer"] == "N. N." and not read["passed"]
    page = (tmp_path / "cert.html").read_text()
    assert digest in page and "simulated rig" in page and "Signed with Ed25519" in page
    assert "calibrate" in page and page.count("<svg") > 20 and "http" not in page
    assert (tmp_path / "cert.pdf").read_bytes()[:5] == b"%PDF-"
    for name in ("cert.json", "cert.html", "cert.pdf"):
        signature = (tmp_path / f"{name}.sig").read_bytes()
        key.public_key().verify(signature, (tmp_path / name).read_bytes())
    write_certificate(content, tmp_path / "cert", None, pdf=False)
    left = {"key.pem", "cert.json", "cert.html"}  # an earlier PDF, or its signature, would say something else
    assert {path.name for path in tmp_path.iterdir()} == left
    text = (tmp_path / "cert.json").read_text()
    (tmp_path / "cert.json").write_text(text.replace('"passed": false', '"passed": true'))
    with pytest.raises(InputError, match="was changed after it was written"):
        read_certificate(tmp_path / "cert.json")


def new_key(folder: Path, name: str) -> Path:
    key = Ed25519PrivateKey.generate()
    path, public = folder / f"{name}.pem", folder / f"{name}.public.pem"
    path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    public.write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    return path


def edit(path: Path) -> None:
    """Change a word of a file; the digest inside a JSON is made anew."""
    if path.suffix == ".json":
        content = json.loads(path.read_text()) | {"passed": True}
        del content["content_sha256"]
        write_sealed(content, path)
    else:
        path.write_bytes(path.read_bytes().replace(b"o", b"0", 1))


@pytest.mark.parametrize(
    ("change", "code", "said"),
    [
        ("nothing", 0, "valid: cert.json, cert.html, cert.pdf"),
        ("cert.json", 5, "changed: cert.json isn't what was signed"),
        ("cert.html", 5, "changed: cert.html isn't what was signed"),
        ("cert.pdf", 5, "changed: cert.pdf isn't what was signed"),
        ("a byte of cert.json", 5, "changed: "),
        ("signed anew", 5, "unknown key: no signature is by"),
        ("another's page", 5, "cert.pdf was signed for another certificate"),
        ("cert.html.sig", 5, "not signed: cert.html has no signature"),
        ("a short signature", 5, "changed: cert.pdf"),
        ("no certificate", 3, "is missing"),
        ("no public key", 3, "is not a readable public key"),
        ("only the page", 0, "whether these belong together isn't known"),
    ],
)
def test_a_certificate_is_checked(
    change: str, code: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own, other = new_key(tmp_path, "own"), new_key(tmp_path, "other")
    content, files = accepted(()), certificate_files(tmp_path / "cert")
    write_certificate(content | {"yard": "another"}, tmp_path / "cert", own, pdf=True)
    others = [path.read_bytes() for path in (files[2], signature_of(files[2]))]
    write_certificate(content, tmp_path / "cert", own, pdf=True)
    if change in ("cert.json", "cert.html", "cert.pdf"):
        edit(tmp_path / change)
    elif change == "a byte of cert.json":
        files[0].write_bytes(files[0].read_bytes().replace(b"false", b"true ", 1))
    elif change == "signed anew":
        write_certificate(content | {"passed": True}, tmp_path / "cert", other, pdf=True)
    elif change == "another's page":
        for path, read in zip((files[2], signature_of(files[2])), others, strict=True):
            path.write_bytes(read)
    elif change == "cert.html.sig":
        (tmp_path / change).unlink()
    elif change == "a short signature":
        signature_of(files[2]).write_bytes(b"x")
    elif change in ("no certificate", "only the page"):
        for path in files[: 3 if change == "no certificate" else 2]:
            path.unlink()
    public = own if change == "no public key" else tmp_path / "own.public.pem"
    assert run(["accept", "--check", str(tmp_path / "cert"), "--key", str(public)]) == code
    told = capsys.readouterr()
    assert said in (told.out + told.err).replace("\n", " ")
    assert code or change == "only the page" or "it says: FAILED" in told.out


def test_a_folder_to_keep_results_in_is_new(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "plan.toml").write_text(plan_text(planned()))
    line = ["accept", str(tmp_path / "plan.toml"), "nowhere", "-o", str(tmp_path / "cert"), "--keep"]
    for keep, reason in ((tmp_path, "not an empty folder"), (tmp_path / "plan.toml" / "new", "is a file")):
        assert run([*line, str(keep)]) == 4
        assert reason in capsys.readouterr().err.replace("\n", " ")


def test_letters_that_a_pdf_lacks_are_spelled_and_said(tmp_path: Path) -> None:
    """They were black squares: nobody could read who signed."""
    for signer, shown in (
        ("Łukasz Żółty, Бrno", b"Lukasz Z\\363lty, ?rno"),
        ("Jörg Groß", b"J\\366rg Gro\\337"),
    ):
        write_certificate(accepted() | {"signer": signer}, tmp_path / "cert", None, pdf=True)
        streams = (tmp_path / "cert.pdf").read_bytes().split(b"stream\n")[1::2]
        pages = b"".join(zlib.decompress(base64.a85decode(one.partition(b"~>")[0])) for one in streams)
        assert shown in pages and (b"Letters that this PDF lacks" in pages) == ("?" in str(shown))


def test_a_wrong_key_is_refused_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "key.pem").write_text("no key")
    (tmp_path / "plan.toml").write_text(plan_text(planned()))
    line = ["accept", str(tmp_path / "plan.toml"), "nowhere", "-o", str(tmp_path / "cert")]
    assert run([*line, "--key", str(tmp_path / "key.pem")]) == 3
    assert "is not a readable private key" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["key.pem", "plan.toml"]


def test_a_plan_stands_on_free_floor_only() -> None:
    """Half of the yard is stacked: everything goes to the other half, and nothing overlaps; a full yard is
    refused.
    """
    _, x = np.mgrid[-3:3:0.02, -1:9:0.02]
    ones = np.ones(x.shape, np.float32)
    stacked = HeightMap(
        -1, -3, 0.02, np.where(x < 3, 0.9, 0.0).astype(np.float32), ones, ones, ones.astype(np.uint8)
    )
    area = Area((0.0, 8.0), (-2.5, 2.5), 4.5, 625.0, 0.5)
    plan = lay_out(area, "half", stacked)
    assert isinstance(plan, AcceptancePlan)
    places = np.array([[one.x_m, one.y_m] for one in plan.artefacts])
    assert places[:, 0].min() > 3.1
    apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 9 * np.eye(len(places))
    assert apart.min() > 0.4
    full = dataclasses.replace(stacked, z_m=ones)
    assert isinstance(lay_out(area, "full", full), Failed)


@pytest.mark.parametrize("above_floor_m", [4.5, 7.0, 10.0, 14.0])
def test_bare_floor_passes_for_no_plate(above_floor_m: float) -> None:
    plan = lay_out(Area((0.0, 20.0), (-4.0, 4.0), above_floor_m, 1250.0, 0.5), "high")
    assert isinstance(plan, AcceptancePlan)
    floor = height_map(lambda x, y: 0 * x)
    for plate in plan.plate:
        found = fit_plate(floor, replace(plate, x_m=1.0, y_m=0.75), plan.conditions.search_m)
        if not isinstance(found, Failed):
            assert decide(1e3 * (found.z_m - plate.z_m), 1.0, plan.limits.height_mm) is Decision.FAILED


def test_a_plan_is_simulated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "plan.toml").write_text(plan_text(planned()))
    line = ["simulate", str(tmp_path / "rec"), "--artefacts", str(tmp_path / "plan.toml"), "--length", "4"]
    small = [
        "--frames",
        "2",
        "--camera.width-px",
        "64",
        "--camera.height-px",
        "64",
        "--camera.focal-px",
        "60",
    ]
    assert run([*line, *small, "--depth-views", "0", "--camera.above-floor-m", "4.5"]) == 0
    truth = np.load(tmp_path / "rec" / "truth" / "height.npz")
    for plate in planned().plate:
        column, row = np.abs(truth["x"] - plate.x_m).argmin(), np.abs(truth["y"] - plate.y_m).argmin()
        assert truth["z"][column, row] == pytest.approx(plate.z_m, abs=1e-6)
    capsys.readouterr()
    assert run([*line, "--draw", "3"]) == 2 and "takes no drawn world" in capsys.readouterr().err
