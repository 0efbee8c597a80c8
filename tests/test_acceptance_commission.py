"""The guided way: steps are done once, again where something changed, and end in a certificate."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from barsight.acceptance.certificate import read_certificate
from barsight.acceptance.commissioning import SETTINGS, GuidedStep, begin, read_done, walk
from barsight.acceptance.layout import Area, lay_out
from barsight.artefacts.plan import AcceptancePlan, plan_text
from barsight.calibration.files.rig_file import write_rig_file
from barsight.cli.main import run
from barsight.core.errors import InputError, MeasurementError
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


@pytest.mark.slow
def test_the_whole_way_from_a_drawn_crane_to_the_certificate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rig file is brought along; then a wrong one: the travel refuses it."""
    plan = lay_out(Area((0.2, 3.8), (-1.35, 1.35), 4.5, 625.0, 0.5), "drawn")
    assert isinstance(plan, AcceptancePlan)
    (tmp_path / "plan.toml").write_text(plan_text(plan))
    crane = tmp_path / "crane"
    assert run(["commission", str(crane)]) == 5
    camera = ["--camera.width-px", "640", "--camera.height-px", "512", "--camera.focal-px", "625"]
    placed = ["--camera.above-floor-m", "4.5", "--camera.trolley-y-m", "0", "--depth-views", "0"]
    drawn = ["--artefacts", str(tmp_path / "plan.toml"), "--length", "4", "--frames", "10", *camera, *placed]
    (crane / "artefacts").mkdir()
    for target, seed in ((crane / "artefacts" / "first", "23"), (crane / "artefacts" / "again", "23")):
        assert run(["simulate", str(target), "--seed", seed, *drawn]) == 0
    shutil.copytree(crane / "artefacts" / "first", crane / "survey")
    rig = open_recording(crane / "survey").rig
    write_rig_file(crane / "rig.yaml", turn_right_camera(rig, np.array([0.0, np.radians(0.05), 0.0])))
    assert run(["commission", str(crane)]) == 5
    assert "yaw" in capsys.readouterr().err
    assert [one.name for one in read_done(crane)] == ["cameras"]
    write_rig_file(crane / "rig.yaml", rig)
    (crane / "plan.toml").write_text(plan_text(plan))
    assert run(["commission", str(crane)]) == 0, capsys.readouterr().err
    certificate = read_certificate(crane / "certificate.json")
    assert certificate["passed"] and certificate["is_simulated"]
    assert [one["name"] for one in certificate["steps"]] == ["cameras", "travel", "empty yard", "plan"]
    before = (crane / "certificate.json").read_bytes()
    assert run(["commission", str(crane)]) == 0 and (crane / "certificate.json").read_bytes() == before
