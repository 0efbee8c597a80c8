"""The magnet's offset by touch-downs: averaged, taken off the crane's target, bound to its rig."""

import cmath
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from barsight.acceptance.acceptance import Acceptance, accept
from barsight.acceptance.budgets.touch_downs import touched_offset
from barsight.acceptance.certificate import certificate_content, write_certificate
from barsight.acceptance.quantities import judge_all
from barsight.artefacts.plan import TouchDown
from barsight.cli.main import run
from barsight.core.errors import ConfigError, InputError
from barsight.core.reading.sealed_json import write_sealed
from barsight.measure_settings import MeasureSettings
from barsight.plant.state import offered_lift
from barsight.store.confirmation import OpenLift
from barsight.store.lift_records import find_gap, find_outlines
from barsight.store.opening import Store
from barsight.yard.axes import corners
from barsight.yard.lifting.lift_file import lifts_content, read_lifts, write_lifts
from barsight.yard.lifting.targets import offset_vetoes, plan_lifts, put_down
from barsight.yard.magnet.description import MagnetOffset, example_magnet, load_magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.placement.load import Load
from lift_yards import GIVEN, MAGNET, SETTINGS, laid, map_of, record, sure_travel
from test_acceptance import CLEAN, observed, off_by, planned
from yard_folders import schema

HANGS_M = np.array([0.012, -0.007, 0.004])
"""Seen minus read."""
OFFSET = MagnetOffset(*HANGS_M.tolist(), 0.001, 0.002, 0.0015, "cal", "yard", 0.0)


def turned(xy_m: tuple[float, float], yaw_deg: float) -> tuple[float, float]:
    """A vector turned about Z, by complex numbers."""
    vector = complex(*xy_m) * cmath.exp(1j * np.radians(yaw_deg))
    return vector.real, vector.imag


def certificate(
    folder: Path, rng: np.random.Generator, count: int = 6, offset: MagnetOffset | None = None,
    stray_m: float = 0.0, artefacts: int = 5, recordings: int = 1, map_m: float = 0.0,
    scatter_m: float = 0.002, apart_m: float = 0.0, yaws_deg: Sequence[float] = (0.0,),
    turns_m: tuple[float, float] = (0.0, 0.0),
) -> Path:  # fmt: skip
    """A certificate with touch-downs that scatter by `scatter_m`, on spheres that recordings see `map_m` off.
    stray_m: added to the third's x. apart_m: added to every other one's. yaws_deg: of the magnet, one for
    each round of the artefacts. turns_m: what hangs off along x and y at yaw 0 and turns with it.
    """
    plan = replace(planned(), dummy_bundle=())
    tops = [np.array([s.x_m, s.y_m, s.z_m + s.diameter_m / 2]) for s in plan.sphere[:artefacts]]
    yaws = [yaws_deg[k // artefacts % len(yaws_deg)] for k in range(count)]
    hangs = [HANGS_M + np.array([*turned(turns_m, yaw), 0.0]) for yaw in yaws]
    read = [tops[k % artefacts] - hangs[k] + rng.normal(0, scatter_m, 3) for k in range(count)]
    read[2:3] = [place + np.array([stray_m, 0, 0]) for place in read[2:3]]
    read[::2] = [place + np.array([apart_m, 0, 0]) for place in read[::2]]
    touched = tuple(
        TouchDown(f"touch {k}", plan.sphere[k % artefacts].name, *place.tolist(), 0.001, yaws[k])
        for k, place in enumerate(read)
    )
    plan = replace(plan, touch_down=touched)
    views = []
    for _ in range(recordings):
        seen = observed(plan, off_by(), rng)
        spheres = {
            s.name: replace(
                seen.spheres[s.name],  # type: ignore[type-var]
                centre_m=np.array([s.x_m, s.y_m, s.z_m]) + rng.normal(0, map_m, 3),
            )
            for s in plan.sphere
        }
        views.append(replace(seen, spheres=spheres))
    judged = tuple(q for q in judge_all(plan, views, offset) if q.group != "repeat_mm")
    found = Acceptance(plan, tuple(views), judged, (), (CLEAN,), (), {"rec": {}}, offset)
    write_certificate(certificate_content(found, "N. N."), folder / "cert", None, pdf=False)
    return folder / "cert.json"


def calibrated(folder: Path, path: Path) -> int:
    (folder / "magnet.toml").write_text(example_magnet())
    line = ["calibrate", "magnet", str(path), "--magnet", str(folder / "magnet.toml")]
    return run([*line, "-o", str(folder / "hung.toml")])


@pytest.mark.parametrize(("recordings", "count", "map_m"), [(1, 6, 0.0), (3, 6, 0.0014), (1, 20, 0.0014)])
def test_the_mean_of_touch_downs_lies_within_its_sigma(
    recordings: int, count: int, map_m: float, tmp_path: Path
) -> None:
    """Forty commissionings: errors over sigma, three axes each. What one artefact is seen off is in all its
    touch-downs, and the worst of several recordings is further off than their mean.
    """
    off = []
    for seed in range(40):
        rng = np.random.default_rng((24, seed))
        found = touched_offset(
            certificate(tmp_path, rng, count, recordings=recordings, map_m=map_m), MAGNET.tolerance
        )
        off.append((found.place_m(0.0) - HANGS_M) / found.sigma_m(0.0))
    assert np.mean(np.abs(off) < 2) > 0.94, "95.45 % by Student's t"
    assert 0.5 < np.std(off) < 1.1


@pytest.mark.parametrize("yaws_deg", [(0.0, 90.0), (0.0, 45.0, 180.0), (10.0, -35.0)])
def test_touch_downs_at_several_yaws_tell_what_turns_with_the_magnet(
    yaws_deg: tuple[float, ...], tmp_path: Path
) -> None:
    """Thirty commissionings, each judged at the yaws of its touch-downs and at 120 degrees."""
    near, far = [], []
    for seed in range(30):
        rng = np.random.default_rng((25, seed))
        turns_m = (-0.02, 0.015)
        made = certificate(tmp_path, rng, 15, map_m=0.0014, yaws_deg=yaws_deg, turns_m=turns_m)
        found = touched_offset(made, MAGNET.tolerance)
        assert found.turn_sigma_m is not None
        for yaw_deg, off in (*((yaw, near) for yaw in yaws_deg), (120.0, far)):
            true_m, yaw_rad = HANGS_M + np.array([*turned(turns_m, yaw_deg), 0.0]), np.radians(yaw_deg)
            off.append((found.place_m(yaw_rad) - true_m) / found.sigma_m(yaw_rad))
    for off in (near, far):
        assert np.mean(np.abs(off) < 2) > 0.94 and 0.3 < np.std(off) < 1.1


def test_an_offset_known_at_one_yaw_is_used_near_it_only(tmp_path: Path) -> None:
    made = certificate(tmp_path, np.random.default_rng(24), yaws_deg=(-90.0,), turns_m=(0.01, 0.0))
    found = touched_offset(made, MAGNET.tolerance)
    assert found.turn_sigma_m is None and found.yaw_deg == pytest.approx(-90)
    (own, near), tight = (found.sigma_m(np.radians(yaw)) for yaw in (-90, -85)), found.x_sigma_m
    assert own[0] == pytest.approx(tight) and near[0] > own[0] + 1e-4 and near[2] == own[2]
    bundle = record(laid(0.3))
    for hung, codes in ((found, ["magnet-turned"]), (replace(found, yaw_deg=-8.0), [])):
        plan = plan_lifts(map_of([laid(0.3)]), (bundle,), replace(MAGNET, offset=hung), SETTINGS, ())
        assert [veto.code for lift in plan.refused for veto in lift.vetoes] == codes
    assert "touch down at this yaw too" in plan_lifts(
        map_of([laid(0.3)]), (bundle,), replace(MAGNET, offset=found), SETTINGS, ()
    ).refused[0].vetoes[0].reason  # fmt: skip
    assert "at yaw -90.0 deg, within 10 deg" in found.words


@pytest.mark.parametrize("yaw_deg", [-0.5, 3.0])
def test_a_beam_lies_along_a_bundle_in_the_direction_of_its_touch_downs(yaw_deg: float) -> None:
    """Bundles have no direction: one along X is found at 89 or at -89 degrees, as it happens."""
    lies, magnet = laid(0.3, yaw_deg=yaw_deg), replace(MAGNET, offset=replace(OFFSET, yaw_deg=yaw_deg))
    other = replace(MAGNET, offset=replace(OFFSET, yaw_deg=yaw_deg + 180))
    (near,), (far,) = (
        plan_lifts(map_of([lies]), (record(lies),), one, SETTINGS, ()).offered for one in (magnet, other)
    )
    for one, turned in ((near.place, far.place), (near.magnet_down, far.magnet_down)):
        assert one is not None and turned is not None
        assert (turned.x_m, turned.y_m) == pytest.approx((one.x_m, one.y_m))
        assert abs(turned.yaw_deg - one.yaw_deg) == pytest.approx(180) and abs(turned.yaw_deg) <= 180
    assert far.safety == pytest.approx(near.safety)


def test_what_turns_with_the_magnet_is_turned_at_its_target_and_set_down(store: Store) -> None:
    """A load that is lifted at yaw 0 and put down at 90 degrees, beside what the store then protects."""
    turns = replace(OFFSET, along_m=0.03, across_m=-0.01, turn_sigma_m=0.001)
    stock = [laid(0.3)]
    plan = plan_lifts(map_of(stock), (record(stock[0]),), replace(MAGNET, offset=turns), SETTINGS, ())
    (lift,) = plan.offered
    over = Placement(3.0, 4.0, np.radians(90.0))
    (row,) = lifts_content(replace(plan, offered=(replace(lift, magnet_down=over),)), "yard", GIVEN, "0")[
        "lifts"
    ]
    off = [row["target"][axis] - row["crane_target"][axis] for axis in ("x_m", "y_m")]
    assert off == pytest.approx([0.012 - 0.01, -0.007 + 0.03], abs=1e-6)
    down = [row["crane_set_down"][axis] for axis in ("x_m", "y_m")]
    assert down == pytest.approx([3 - 0.012 + 0.03, 4 + 0.007 + 0.01], abs=1e-6)
    size = dict(zip(("width_m", "length_m"), MAGNET.size_m, strict=True))
    with store.reading() as connection:
        found = find_outlines(connection, 1, 1, row | {"beam": size, "offset": asdict(turns)})
    assert np.abs(found[1] - corners((3.0, 4.0), over.yaw_rad, *MAGNET.size_m)).max() < 1e-6


def test_a_magnets_file_gets_the_offset_of_its_rig(tmp_path: Path) -> None:
    assert calibrated(tmp_path, certificate(tmp_path, np.random.default_rng(24))) == 0
    found = load_magnet(tmp_path / "hung.toml").offset
    assert found is not None and (found.calibration_id, found.yard_frame_id) == ("cal", "yard")
    assert np.all(np.abs(found.place_m(0.0) - HANGS_M) < 3 * found.sigma_m(0.0))
    text = (tmp_path / "hung.toml").read_text()
    (tmp_path / "old.toml").write_text(text.replace("yaw_deg = 0.00000\n", ""))
    with pytest.raises(ConfigError, match=r"offset\.yaw_deg is missing"):
        load_magnet(tmp_path / "old.toml")
    turned = certificate(tmp_path, np.random.default_rng(24), 10, yaws_deg=(0.0, 90.0), turns_m=(0.02, 0.0))
    assert calibrated(tmp_path, turned) == 0
    found = load_magnet(tmp_path / "hung.toml").offset
    assert found is not None and found.turn_sigma_m is not None
    assert np.hypot(found.across_m - 0.02, found.along_m) < 4 * found.turn_sigma_m


def test_an_offset_is_taken_off_what_the_crane_gets(tmp_path: Path) -> None:
    stock = [laid(0.3), laid(1.5)]
    bundles = tuple(record(one, k) for k, one in enumerate(stock))
    hung = replace(MAGNET, offset=OFFSET)
    contents = {}
    for magnet in (MAGNET, hung):
        plan = plan_lifts(map_of(stock), bundles, magnet, SETTINGS, ())
        contents[magnet] = lifts_content(plan, "yard", GIVEN, "0")
    plain, told = contents[MAGNET]["lifts"], contents[hung]["lifts"]
    assert len(plain) == len(told) == 2
    for before, after in zip(plain, told, strict=True):
        assert after["target"] == before["target"] == before["crane_target"]
        names = ("x_m", "y_m", "z_m")
        moved = [before["target"][name] - after["crane_target"][name] for name in names]
        assert moved == pytest.approx(HANGS_M, abs=1e-8)
        assert after["crane_target"]["yaw_deg"] == before["target"]["yaw_deg"]
        added = np.array(after["target_covariance"]) - np.array(before["target_covariance"])
        wanted = np.diag([*np.square(OFFSET.sigma_m(0.0)), 0])
        assert added == pytest.approx(wanted, abs=1e-11)
        down, crane = before["crane_set_down"], after["crane_set_down"]
        assert [down[name] - crane[name] for name in names] == pytest.approx(HANGS_M, abs=1e-8)
    write_lifts(plan, "yard", GIVEN, "0", tmp_path / "lifts.json")
    kept = read_lifts(tmp_path / "lifts.json")
    assert kept["magnet"]["offset"]["x_m"] == 0.012
    jsonschema.validate(kept, schema("lifts"))
    row = kept["lifts"][0] | {"valid_until_ns": 5}
    offered = offered_lift(OpenLift(1, 1, "map", "cal", "offered", row), None, ())
    assert offered.x_m == row["crane_target"]["x_m"] and offered.set_down_y_m == row["crane_set_down"]["y_m"]


def test_a_magnet_off_the_middle_of_its_load_hangs_there_at_set_down_too(store: Store) -> None:
    """Its own place there decides which offers end."""
    stock = [laid(0.3)]
    bundles = (record(stock[0]),)
    plan = plan_lifts(map_of(stock), bundles, replace(MAGNET, offset=OFFSET), SETTINGS, ())
    lift = replace(plan.offered[0], place=Placement(0.3, 0.25, 0.0))
    lift = put_down(lift, Load.of(bundles), plan.offered[0].set_down)
    (row,) = lifts_content(replace(plan, offered=(lift,)), "yard", GIVEN, "0")["lifts"]
    size = dict(zip(("width_m", "length_m"), MAGNET.size_m, strict=True))
    down, load = lift.magnet_down, lift.set_down
    assert down is not None and load is not None
    assert np.hypot(down.x_m - load.x_m, down.y_m - load.y_m) == pytest.approx(0.25, abs=0.01)
    with store.reading() as connection:
        found = find_outlines(connection, 1, 1, row | {"beam": size})
    wanted = corners((down.x_m, down.y_m), down.yaw_rad, *MAGNET.size_m)
    assert np.abs(found[1] - wanted).max() < 1e-3
    beyond = corners((down.x_m, down.y_m + MAGNET.size_m[1] / 2 + 0.9), 0.0, 0.1, 0.0)
    assert find_gap(found, [beyond]) < SETTINGS.disturbed_reach_m


def test_an_unsure_offset_forbids_what_the_tolerance_cannot_hold() -> None:
    stock = [laid(0.3)]
    travel = sure_travel(np.array([[0.3, 0.0]]), np.array([1]))
    unsure = replace(MAGNET, offset=replace(OFFSET, x_sigma_m=MAGNET.tolerance.x_m))
    plan = plan_lifts(map_of(stock), (record(stock[0]),), unsure, SETTINGS, (), travel, 1)
    assert plan.offered == ()
    (veto,) = plan.refused[0].vetoes
    assert veto.code == "trajectory-degraded" and "trajectory and touch-downs" in veto.reason


def test_another_rigs_or_frames_offset_forbids_every_lift() -> None:
    hung = replace(MAGNET, offset=OFFSET)
    assert offset_vetoes(hung, "cal", "yard") == () == offset_vetoes(MAGNET, "any", None)
    for ids, what in ((("other", "yard"), "another calibration"), (("cal", None), "another yard frame")):
        (veto,) = offset_vetoes(hung, *ids)
        assert veto.code == "calibration-changed" and what in veto.reason


def test_later_touch_downs_are_judged_with_the_offset(tmp_path: Path) -> None:
    bare = json.loads(certificate(tmp_path, np.random.default_rng(7)).read_text())
    hung = json.loads(certificate(tmp_path, np.random.default_rng(7), offset=OFFSET).read_text())
    rows = {row["name"]: row for row in hung["quantities"] if row["group"] == "touch_mm"}
    for row in (row for row in bare["quantities"] if row["group"] == "touch_mm"):
        axis = "xyz".index(row["name"][-1])
        other = rows[row["name"]]
        assert row["error"] - other["error"] == pytest.approx(1e3 * HANGS_M[axis])
        assert other["uncertainty"]["sigma"] == pytest.approx(np.hypot(1.0, 1e3 * OFFSET.sigma_m(0.0)[axis]))


@pytest.mark.parametrize(
    ("own", "said"), [(6, "touch 0, touch 1, touch 2 ..."), (1, "touch 0, which"), (0, "")]
)
def test_touch_downs_do_not_verify_their_own_mean(own: int, said: str, tmp_path: Path) -> None:
    """They are known by their readings, whatever a plan calls them, and before anything is measured."""
    path = certificate(tmp_path, np.random.default_rng(24))
    offset = touched_offset(path, MAGNET.tolerance)
    downs = [TouchDown(**one) for one in json.loads(path.read_text())["plan"]["touch_down"]]
    others = [replace(one, x_m=one.x_m + 0.001) for one in downs]
    plan = replace(planned(), touch_down=(*downs[:own], *others[own:]))
    with pytest.raises(ConfigError, match=said) if own else pytest.raises(InputError):
        accept(plan, [tmp_path / "none"], MeasureSettings(), tmp_path, lambda *_: None, offset)
    with pytest.raises(ConfigError, match="has no touch_down to verify"):
        accept(replace(plan, touch_down=()), [], MeasureSettings(), tmp_path, lambda *_: None, offset)


def test_a_touch_down_listed_under_two_names_counts_once() -> None:
    plan = planned()
    one = TouchDown("touch", plan.sphere[0].name, 1.0, 2.0, 3.0)
    with pytest.raises(ConfigError, match="has the readings of another touch-down"):
        replace(plan, touch_down=(one, replace(one, name="again")))


@pytest.mark.parametrize(
    ("made", "said"),
    [
        ({"count": 2}, "3 are the least"),
        ({"artefacts": 2}, "are on 2 artefacts, 3 are the least"),
        ({"artefacts": 3}, "its touch-downs span 0.8 m of 2.7 m along x"),
        ({"offset": OFFSET}, "accept without --magnet"),
        ({"scatter_m": 0.02}, "more than the magnet's tolerance holds"),
        ({"stray_m": 0.04}, "touch 2 lies"),
        ({"count": 12, "apart_m": 0.02}, "lie in two groups"),
        ({"count": 6, "yaws_deg": (0.0, 90.0)}, "with the magnet turned on one artefact only"),
    ],
)
def test_what_carries_no_offset_is_refused(
    made: dict[str, Any], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert calibrated(tmp_path, certificate(tmp_path, np.random.default_rng(8), **made)) == 3
    assert said in capsys.readouterr().err.replace("\n", " ") and not (tmp_path / "hung.toml").exists()


def test_a_failed_rig_and_a_file_with_an_offset_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(8)
    path = certificate(tmp_path, rng)
    assert calibrated(tmp_path, path) == 0
    line = ["calibrate", "magnet", str(path), "--magnet", str(tmp_path / "hung.toml")]
    assert run([*line, "-o", str(tmp_path / "again.toml")]) == 3 and not (tmp_path / "again.toml").exists()
    assert "has an [offset] already" in capsys.readouterr().err.replace("\n", " ")
    content = json.loads(path.read_text())
    del content["content_sha256"]
    write_sealed(content | {"rig": [{"state": "recalibrate", "lines": []}]}, path)
    assert calibrated(tmp_path, path) == 3
    assert "isn't accepted (the crane's travel: recalibrate)" in capsys.readouterr().err.replace("\n", " ")
    plan = replace(planned(), dummy_bundle=(), touch_down=())
    seen = observed(plan, off_by(baseline=0.02), rng)
    found = Acceptance(plan, (seen,), judge_all(plan, [seen]), (), (CLEAN,), (), {"rec": {}})
    write_certificate(certificate_content(found, ""), path, None, pdf=False)
    assert calibrated(tmp_path, path) == 3 and "isn't accepted" in capsys.readouterr().err.replace("\n", " ")
