"""The watch over the years: false alarms, a jump, approvals, and the command on a simulated survey."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from barsight.acceptance.watch.charts import control_charts
from barsight.acceptance.watch.figures import beyond_limits, feature_figures, rig_figures, tag_figures
from barsight.acceptance.watch.record import (
    Approval,
    WatchedFigure,
    WatchedSurvey,
    WatchRecord,
    read_watch,
    with_survey,
    write_watch,
)
from barsight.artefacts.plan import ErrorLimits
from barsight.cli.acceptance import verify
from barsight.cli.main import run
from barsight.core.errors import Failed, InputError
from barsight.motion.rig_check.drift_check import RigCheck
from barsight.motion.rig_check.epipolar_error import RowDrift
from barsight.registration.surveyed_targets import SurveyedTags
from barsight.registration.tags import PlacedTag
from test_acceptance import CLEAN, observed, planned

SIGMAS = {"yaw / deg": 0.0018, "baseline / %": 0.05, "pitch / deg": 0.0014, "sharpness of cam0 / log": 0.15}


def survey(number: int, rng: np.random.Generator, yaw_deg: float = 0.0, id_: str = "cal") -> WatchedSurvey:
    """Draw a healthy survey with a constant offset of its own calibration; yaw_deg: a jump."""
    figures = tuple(
        WatchedFigure(name, 2 * sigma + rng.normal(0, sigma) + yaw_deg * (name == "yaw / deg"), sigma)
        for name, sigma in SIGMAS.items()
    )
    return WatchedSurvey(f"rec{number}", f"id{number}", id_, figures)


def first_alarm(surveys: list[WatchedSurvey]) -> int | None:
    alarms = [chart.alarmed_at for chart in control_charts(surveys) if chart.alarmed_at is not None]
    return min(alarms, default=None)


def false_alarms(runs: int, surveys: int, seed: int) -> int:
    found = 0
    for number in range(runs):
        rng = np.random.default_rng((seed, number))
        found += first_alarm([survey(k, rng) for k in range(surveys)]) is not None
    return found


def late_alarms(runs: int, seed: int, sigma_deg: float = 0.0018) -> int:
    """Jumps of 0.01 degrees after ten surveys that aren't told within three."""
    late = 0
    for number in range(runs):
        rng = np.random.default_rng((seed, number))
        jump = 0.01 * SIGMAS["yaw / deg"] / sigma_deg
        drawn = [survey(k, rng) for k in range(10)]
        drawn += [survey(k, rng, yaw_deg=jump) for k in range(10, 13)]
        alarm = first_alarm(drawn)
        late += alarm is None or alarm <= 10
    return late


def test_sigmas_that_are_stated_too_small_raise_few_alarms_and_hide_no_jump() -> None:
    """Healthy surveys that scatter by one and a half to two and a half of the stated sigmas, then a jump."""
    for ratio in (1.5, 2.0, 2.5):
        alarms = jumps = 0
        for seed in range(100):
            rng = np.random.default_rng((46, seed))
            values = 3.0 + rng.normal(0, ratio, 60)
            alarms += first_alarm(with_values(values)) is not None
            values[25:] += 5 * ratio
            alarm = first_alarm(with_values(values[:28]))
            jumps += alarm is None
        assert alarms <= 13 and jumps == 0


def with_values(values: np.ndarray) -> list[WatchedSurvey]:
    figures = (WatchedFigure("yaw / deg", float(value), 1.0) for value in values)
    return [WatchedSurvey(f"rec{k}", f"id{k}", "cal", (figure,)) for k, figure in enumerate(figures)]


def test_healthy_surveys_are_quiet_and_a_jump_is_told_within_three() -> None:
    assert false_alarms(4, 1000, 31) == 0
    assert late_alarms(100, 32) <= 1


@pytest.mark.slow
def test_forty_thousand_healthy_surveys_alarm_at_most_forty_times() -> None:
    assert false_alarms(40, 1000, 33) <= 40
    assert late_alarms(200, 34) <= 4
    assert late_alarms(400, 39, sigma_deg=0.0024) <= 20


def test_a_slow_drift_is_told_too() -> None:
    rng = np.random.default_rng(35)
    drawn = [survey(k, rng, yaw_deg=4e-4 * max(k - 10, 0)) for k in range(60)]
    chart = next(one for one in control_charts(drawn) if one.name == "yaw / deg")
    assert chart.alarmed_at is not None and 15 < chart.alarmed_at < 40
    assert first_alarm(drawn[:15]) is None


def test_what_is_normal_is_learned_first() -> None:
    rng = np.random.default_rng(36)
    drawn = [survey(k, rng, yaw_deg=0.05 * (k == 7)) for k in range(8)]
    assert all(np.isnan(one.mean) for one in control_charts(drawn[:7]))
    assert first_alarm(drawn) is None


def test_a_stray_survey_among_those_that_are_learned_hides_no_later_jump() -> None:
    told = 0
    for seed in range(40):
        rng = np.random.default_rng((41, seed))
        shifts = [0.03 * (k == 5) + 0.01 * (k >= 10) for k in range(13)]
        alarm = first_alarm([survey(k, rng, yaw_deg=shift) for k, shift in enumerate(shifts)])
        told += alarm is not None and alarm > 10
    assert told >= 38


def test_travel_of_unequal_length_is_no_drift_of_the_yaw() -> None:
    """A calibration that is a little wrong shifts the yaw by rows only, the same in every survey."""

    def seen(rng: np.random.Generator, shift_deg: float, jump_deg: float) -> RigCheck:
        by_rows, by_travel = 0.0014, float(rng.choice([0.0015, 0.015]))
        yaw = np.radians([shift_deg + jump_deg + rng.normal(0, by_rows), jump_deg + rng.normal(0, by_travel)])
        covariance = np.diag(np.radians([0.001, 0.001, 0.001, by_rows]) ** 2)
        nothing = np.zeros(1)
        rows = RowDrift(np.append(np.zeros(3), yaw[0]), covariance, 0.0, 0.1, 900, 10, nothing, nothing)
        travel = SimpleNamespace(yaw_rad=yaw[1], yaw_sigma_rad=np.radians(by_travel))
        return RigCheck((), rows, travel, 7.0, np.radians([*[1e-3] * 3, 0.0078]))  # type: ignore[arg-type]

    for jump_deg in (0.0, 0.01):
        alarms = []
        for seed in range(20):
            rng = np.random.default_rng((44, seed))
            checks = [seen(rng, 0.0078, jump_deg * (k >= 17)) for k in range(20)]
            drawn = [WatchedSurvey("r", str(k), "cal", rig_figures(one)) for k, one in enumerate(checks)]
            alarms.append(first_alarm(drawn))
        assert alarms == [None] * 20 if jump_deg == 0 else all(a is not None and a > 17 for a in alarms)


def test_a_figure_that_is_no_longer_seen_has_no_value() -> None:
    rng = np.random.default_rng(42)
    drawn = [survey(k, rng) for k in range(12)]
    last = replace(drawn[-1], figures=drawn[-1].figures[1:])
    yaw, baseline, *_ = control_charts([*drawn[:-1], last])
    assert np.isnan(yaw.value) and np.isfinite(yaw.mean) and baseline.value == last.figures[0].value


def test_a_rig_that_moved_before_its_first_survey_is_beyond_the_limits() -> None:
    plan = planned()
    for moved, said in (
        ((0, 0, 0), []), ((0, 0, 0.02), ["height of plates"]), ((-0.02, 0, 0), ["place of spheres along x"]),
    ):  # fmt: skip
        off = np.array(moved)
        seen = observed(plan, lambda place, off=off: place + off, np.random.default_rng(43))
        figures = feature_figures(plan, seen)
        assert not isinstance(figures, Failed)
        assert [one.partition(" is ")[0] for one in beyond_limits(plan.limits, figures)] == said
    tags = [
        WatchedFigure(f"place of tags along {axis} / mm", 8.0, sigma)
        for axis, sigma in (("x", 2.0), ("z", 1.0))
    ]
    assert beyond_limits(ErrorLimits(), tags) == ["place of tags along z is +8.0 mm off, the limit is 5"]


def test_fixed_features_watch_mounting_and_yard_frame() -> None:
    """Ten surveys of plates and spheres as they scatter; then the rig hangs 6 mm lower, or 8 mm aside."""
    plan = planned()

    def surveys(moved: np.ndarray, seed: int) -> list[WatchedSurvey]:
        rng = np.random.default_rng((38, seed))
        drawn = []
        for k in range(13):
            off = moved * (k >= 10)
            figures = feature_figures(plan, observed(plan, lambda place, off=off: place + off, rng))
            assert not isinstance(figures, Failed)
            drawn.append(WatchedSurvey(f"rec{k}", f"id{k}", "cal", figures))
        return drawn

    quiet = [first_alarm(surveys(np.zeros(3), seed)) for seed in range(20)]
    assert quiet == [None] * 20
    for moved, name in (((0, 0, -0.006), "height of plates"), ((0.008, 0, 0), "place of spheres along x")):
        for seed in range(5):
            charts = control_charts(surveys(np.array(moved), seed))
            alarmed = {one.name.partition(" / ")[0]: one.alarmed_at for one in charts if one.alarmed_at}
            assert list(alarmed) == [name] and 10 < alarmed[name] <= 13


@pytest.mark.parametrize("kind", ["plates", "spheres"])
def test_fixed_features_that_all_got_lost_are_no_quiet_chart(kind: str) -> None:
    """The rig may see them further off than they are sought; one that is lost says nothing."""
    plan = planned()
    seen = observed(plan, lambda place: place, np.random.default_rng(5))
    found = dict(getattr(seen, kind))
    for count, name in enumerate(found):
        assert not isinstance(feature_figures(plan, replace(seen, **{kind: dict(found)})), Failed), count
        found[name] = Failed("not-found", f"{name}: nothing there")
    lost = feature_figures(plan, replace(seen, **{kind: found}))
    assert isinstance(lost, Failed) and "nothing there" in lost.reason


def test_tags_on_columns_are_fixed_features() -> None:
    yard_m = np.array([(0.0, 0.0, 4.0), (8.0, 0.0, 4.0), (8.0, 5.0, 3.0)])
    listed = SurveyedTags(np.array([3, 4, 5]), yard_m, np.full(3, np.nan), np.zeros(3, bool))
    lost = Failed("few-pairs", "tag 5 is seen in no pair, 2 are the least")
    placed = [
        PlacedTag(k, place + off, np.diag([1e-6, 4e-6, 9e-6]), 4, 0, 30.0, place)
        for k, place, off in ((3, yard_m[0], (0.002, 0, 0)), (4, yard_m[1], (0.004, 0, -0.001)))
    ]
    figures = tag_figures(listed, [*placed, lost])
    assert not isinstance(figures, Failed)
    assert [one.name for one in figures] == [f"place of tags along {axis} / mm" for axis in "xyz"]
    assert [(one.value, one.sigma) for one in figures] == [
        pytest.approx(pair) for pair in ((3.0, 1.0), (0.0, 2.0), (-0.5, 3.0))
    ]
    nothing = tag_figures(listed, [lost] * 3)
    assert isinstance(nothing, Failed) and "tag 5" in nothing.reason


def test_an_approval_begins_charts_anew(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(37), tmp_path / "watch.json"
    record = WatchRecord()
    for k in range(15):
        record = with_survey(record, survey(k, rng, yaw_deg=0.05 * (k > 9)), path)
    assert first_alarm(list(record.since_approval)) == 11
    with pytest.raises(InputError, match="approve the new calibration"):
        with_survey(record, survey(15, rng, id_="other"), path)
    with pytest.raises(InputError, match=r"is in watch\.json already"):
        with_survey(record, survey(3, rng), path)
    approval = Approval("N. N.", "knocked", "2026-11-26T12:00:00+00:00", "other", len(record.surveys))
    record = with_survey(WatchRecord(record.surveys, (approval,)), survey(15, rng, 0.0, "other"), path)
    write_watch(record, path)
    assert read_watch(path) == record and len(record.since_approval) == 1
    assert first_alarm(list(record.since_approval)) is None
    path.write_text(path.read_text().replace("knocked", "nothing"))
    with pytest.raises(InputError, match="was changed after it was written"):
        read_watch(path)


@pytest.mark.parametrize(
    ("arguments", "code", "reason"),
    [
        (["nowhere"], 3, "no such file"),
        (["nowhere", "--approve", "N. N."], 2, "go together"),
        (["nowhere", "--record", "watch.txt"], 4, "end its name in .json"),
        (["nowhere", "--plan", "plan.toml"], 3, "no such file"),
    ],
)
def test_bad_input(
    arguments: list[str], code: int, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert run(["verify", *arguments]) == code
    assert reason in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_survey_that_shows_nothing_of_the_rig_is_not_verified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    blind = RigCheck((), Failed("few-rows", "too few matches"), Failed("no-crane", ""), 7.0, np.ones(4))
    for name, found in (("open_recording", None), ("in_yard", None), ("look_at_rig", (blind, CLEAN))):
        monkeypatch.setattr(verify, name, lambda *_, found=found: found)
    assert run(["verify", str(tmp_path), "--record", str(tmp_path / "watch.json")]) == 5
    assert "shows nothing of the rig (too few matches" in capsys.readouterr().err.replace("\n", " ")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_survey_is_verified_once(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["verify", str(data / "yard_dev"), "--record", str(tmp_path / "watch.json")]
    assert run(line) == 0
    assert "learning" in capsys.readouterr().out
    assert run(line) == 3 and "already" in capsys.readouterr().err
    assert len(read_watch(tmp_path / "watch.json").surveys) == 1
