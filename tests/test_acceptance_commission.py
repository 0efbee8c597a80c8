"""The guided way: steps are done once, again where something changed, and end in a certificate."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barsight.acceptance.certificate import read_certificate
from barsight.acceptance.commissioning import SETTINGS, CommissionSettings, GuidedStep, begin, read_done, walk
from barsight.acceptance.layout import Area, lay_out
from barsight.acceptance.watch.record import read_watch
from barsight.artefacts.plan import AcceptancePlan, plan_text
from barsight.calibration.files.rig_file import write_rig_file
from barsight.cli.acceptance.commission import guided_steps
from barsight.cli.main import run
from barsight.core.errors import ConfigError, InputError, MeasurementError, OutputError
from barsight.motion.rig_check.self_calibration import turn_right_camera
from barsight.recording.open import open_recording


def steps(folder: Path, log: list[str]) -> tuple[GuidedStep, ...]:
    """Two steps: b is made of a, d of b and c."""

    def make(name: str, *given: str) -> Callable[[], str]:
        def do() -> str:
            log.append(name)
            (folder / name).write_text("+".join((folder / one).read_text() for one in given))
            return f"{name} made"

        return do

    return (
        GuidedStep("first", ("a",), ("b",), "bring a", make("b", "a")),
        GuidedStep("second", ("b", "c"), ("d",), "bring c", make("d", "b", "c")),
    )


def test_a_folder_that_cannot_be_made_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="a part of the path is a file"):
        begin(tmp_path / "file" / "crane")


def test_each_step_is_done_once_and_again_after_a_change(tmp_path: Path) -> None:
    log: list[str] = []
    done, next_step = walk(tmp_path, steps(tmp_path, log))
    assert done == () and next_step is not None and next_step.bring == "bring a"
    (tmp_path / "a").write_text("a")
    done, next_step = walk(tmp_path, steps(tmp_path, log))
    assert [one.result for one in done] == ["b made"] and next_step is not None and log == ["b"]
    (tmp_path / "c").write_text("c")
    assert walk(tmp_path, steps(tmp_path, log))[1] is None and log == ["b", "d"]
    assert walk(tmp_path, steps(tmp_path, log))[0] == read_done(tmp_path) and log == ["b", "d"]
    (tmp_path / "c").write_text("other")
    walk(tmp_path, steps(tmp_path, log))
    assert log == ["b", "d", "d"]
    (tmp_path / "a").write_text("other")
    walk(tmp_path, steps(tmp_path, log))
    assert log == ["b", "d", "d", "b", "d"] and (tmp_path / "d").read_text() == "other+other"
    (tmp_path / "d").write_text("by hand")
    walk(tmp_path, steps(tmp_path, log))
    assert log[-1] == "d" and len(log) == 6 and (tmp_path / "d").read_text() == "other+other"


def test_a_step_is_done_again_where_its_settings_change(tmp_path: Path) -> None:
    log: list[str] = []
    (tmp_path / "a").write_text("a")
    for told in (
        ("checkerboard:9x6:0.025", 7.0),
        ("checkerboard:9x6:0.025", 7.0),
        ("checkerboard:9x6:0.1", 7.0),
    ):
        walk(tmp_path, [replace(steps(tmp_path, log)[0], told=told)])
    assert log == ["b", "b"]
    before, after = (
        guided_steps(tmp_path, CommissionSettings(board=f"checkerboard:9x6:{m}")) for m in (1, 2)
    )
    assert before[0].told != after[0].told


def test_the_plan_names_the_yard_of_the_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[object, ...]] = []
    monkeypatch.setattr("barsight.cli.acceptance.accept.make_plan", lambda *given: made.append(given))
    for yard in ("north", ""):
        step = next(
            one for one in guided_steps(tmp_path, CommissionSettings(yard=yard)) if one.name == "plan"
        )
        step.do()
    assert [given[-1] for given in made] == ["north", tmp_path.name]


def test_a_failing_step_leaves_those_before_it_done(tmp_path: Path) -> None:
    log: list[str] = []

    def fails() -> str:
        raise MeasurementError("no")

    (tmp_path / "a").write_text("a")
    (tmp_path / "c").write_text("c")
    first, second = steps(tmp_path, log)
    with pytest.raises(MeasurementError):
        walk(tmp_path, (first, GuidedStep(second.name, second.takes, second.makes, second.bring, fails)))
    assert [one.name for one in read_done(tmp_path)] == ["first"]
    walk(tmp_path, (first, second))
    assert log == ["b", "d"]


def test_a_changed_record_and_a_foreign_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("a")
    walk(tmp_path, steps(tmp_path, []))
    record = tmp_path / "commissioning.json"
    record.write_text(record.read_text().replace("b made", "b bought"))
    with pytest.raises(InputError, match="was changed after it was written"):
        read_done(tmp_path)
    with pytest.raises(InputError, match=r"holds no commission\.toml"):
        begin(tmp_path)


def test_a_new_folder_says_what_to_bring(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["commission", str(tmp_path / "crane")]) == 5
    assert "pictures of the board into board/" in capsys.readouterr().err
    settings = tmp_path / "crane" / SETTINGS
    settings.write_text(settings.read_text().replace("range_m = 7.0", "range_m = -7.0"))
    assert run(["commission", str(tmp_path / "crane")]) == 2
    assert "range_m must be positive" in capsys.readouterr().err


def test_a_rig_file_whose_report_says_redo_is_not_brought_along(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where the pictures of a calibration that failed are taken away."""
    begin(tmp_path / "crane")
    (tmp_path / "crane" / "rig.yaml").write_text("cameras: []")
    report = tmp_path / "crane" / "rig.json"
    for verdict, reason in (("redo", "rig.json: says redo of rig.yaml"), ("usable", "next: a recording of")):
        report.write_text(json.dumps({"verdict": verdict}))
        assert run(["commission", str(tmp_path / "crane")]) == 5
        assert reason in capsys.readouterr().err.replace("\n", " ")


def tags_between(plan: AcceptancePlan) -> str:
    """Lay eight tags on the floor where no artefact stands, as far apart as they go; two are checks."""
    spots = np.array([(x, y) for x in np.arange(0.2, 3.9, 0.1) for y in np.arange(-1.3, 1.31, 0.1)])
    stand = np.array([(one.x_m, one.y_m) for one in plan.artefacts])
    reach = np.array([0.85 if one in plan.dummy_bundle else 0.45 for one in plan.artefacts])
    away = np.linalg.norm(spots[:, None] - stand, axis=2)
    free = spots[(away > reach).all(axis=1)]
    chosen = [int(free.sum(axis=1).argmin())]
    while len(chosen) < 8:
        chosen.append(int(np.linalg.norm(free[:, None] - free[chosen], axis=2).min(axis=1).argmax()))
    rows = [
        f"{k + 3},{free[one][0]:.2f},{free[one][1]:.2f},0.03,0.0005,{int(k in (3, 6))}"
        for k, one in enumerate(chosen)
    ]
    return "\n".join(["tag,yard_x,yard_y,yard_z,sigma_m,check", *rows, ""])


def test_an_edited_page_of_the_certificate_is_made_again(tmp_path: Path) -> None:
    """Its JSON alone was watched: a page that somebody had changed stayed."""
    step = next(one for one in guided_steps(tmp_path, CommissionSettings()) if one.name == "acceptance")
    made: list[str] = []

    def do() -> str:
        made.append("again")
        for name in step.makes:
            (tmp_path / name).write_text("FAILED")
        return "failed"

    guided = (replace(step, takes=(), do=do),)
    for edited in ("certificate.html", "certificate.pdf"):
        walk(tmp_path, guided)
        count = len(made)
        walk(tmp_path, guided)
        assert len(made) == count
        (tmp_path / edited).write_text("PASSED")
    walk(tmp_path, guided)
    assert len(made) == 3 and (tmp_path / "certificate.pdf").read_text() == "FAILED"


def test_tags_place_the_yard_before_it_is_measured(tmp_path: Path) -> None:
    made = CommissionSettings(use_tags=True, girder_y_m=(-8.0, 8.0), magnet="magnet.toml")
    listed = guided_steps(tmp_path, made)
    assert [one.name for one in listed] == [
        "cameras", "travel", "yard frame", "empty yard", "plan", "acceptance"
    ]  # fmt: skip
    by_name = {one.name: one for one in listed}
    assert "tags.csv" in by_name["yard frame"].takes and "yard.yaml" in by_name["empty yard"].takes
    assert {"yard.yaml", "magnet.toml"} <= set(by_name["acceptance"].takes)
    listed = guided_steps(tmp_path, CommissionSettings(use_targets=True))
    assert [one.name for one in listed][2:4] == ["empty yard", "yard frame"]
    with pytest.raises(ConfigError, match="take one of them"):
        CommissionSettings(use_tags=True, use_targets=True)
    with pytest.raises(ConfigError, match="girder_y_m needs use_tags"):
        CommissionSettings(girder_y_m=(-8.0, 8.0))


@pytest.mark.slow
def test_the_whole_way_from_a_drawn_crane_to_the_certificate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A wrong rig file, which the travel refuses, then board pictures. Tags place the yard."""
    plan = lay_out(Area((0.2, 3.8), (-1.35, 1.35), 4.5, 625.0, 0.5), "drawn")
    assert isinstance(plan, AcceptancePlan)
    (tmp_path / "plan.toml").write_text(plan_text(plan))
    crane = tmp_path / "crane"
    assert run(["commission", str(crane)]) == 5
    settings = crane / SETTINGS
    settings.write_text(settings.read_text().replace("use_tags = false", "use_tags = true"))
    (crane / "tags.csv").write_text(tags_between(plan))
    camera = ["--camera.width-px", "640", "--camera.height-px", "512", "--camera.focal-px", "625"]
    placed = ["--camera.above-floor-m", "4.5", "--camera.trolley-y-m", "0", "--depth-views", "0"]
    laid = ["--artefacts", str(tmp_path / "plan.toml"), "--tags", str(crane / "tags.csv"), "--tag-m", "0.16"]
    drawn = [*laid, "--length", "4", "--seed", "23", *camera, *placed]
    (crane / "artefacts").mkdir()
    for target, frames in ((crane / "artefacts" / "first", "10"), (crane / "artefacts" / "again", "11")):
        assert run(["simulate", str(target), "--frames", frames, *drawn]) == 0
    shutil.copytree(crane / "artefacts" / "first", crane / "survey")
    rig = open_recording(crane / "survey").rig
    write_rig_file(crane / "rig.yaml", turn_right_camera(rig, np.array([0.0, np.radians(0.05), 0.0])))
    assert run(["commission", str(crane)]) == 5
    assert "yaw" in capsys.readouterr().err
    assert [one.name for one in read_done(crane)] == ["cameras"]
    board = "checkerboard:9x6:0.1"
    settings.write_text(
        settings.read_text()
        .replace("checkerboard:9x6:0.025", board)
        .replace("range_m = 7.0", "range_m = 4.5")
    )
    photographed = ["--seed", "23", "--board", board, "--views", "30", *camera, *placed[:4]]
    assert run(["simulate", str(crane / "board"), *photographed]) == 0
    (crane / "plan.toml").write_text(plan_text(plan))
    assert run(["commission", str(crane)]) == 0, capsys.readouterr().err
    certificate = read_certificate(crane / "certificate.json")
    assert certificate["passed"] and certificate["is_simulated"]
    assert [one["name"] for one in certificate["steps"]] == [
        "cameras", "travel", "yard frame", "empty yard", "plan"
    ]  # fmt: skip
    assert certificate["magnet_offset"] is None and certificate["yard_frame_id"]
    watched = ["--record", str(tmp_path / "watch.json"), "--plan", str(crane / "plan.toml")]
    hung = ["--rig", str(crane / "rig.yaml"), "--yard", str(crane / "yard.yaml")]
    assert run(["verify", str(crane / "artefacts" / "first"), *watched, *hung]) == 0
    (told,) = read_watch(tmp_path / "watch.json").surveys
    features = {one.name: abs(one.value) for one in told.figures if one.name.endswith("/ mm")}
    assert sorted(features) == [
        "height of plates / mm", "place of spheres along x / mm", "place of spheres along y / mm"
    ]  # fmt: skip
    assert max(features.values()) < 4
    before = (crane / "certificate.json").read_bytes()
    assert run(["commission", str(crane)]) == 0 and (crane / "certificate.json").read_bytes() == before
