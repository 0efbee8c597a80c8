"""The Python API: a recording measured as in a notebook."""

import copy
import gc
import json
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pytest

import barsight as bs
from barsight.calibration.files.rig_file import read_covariance
from barsight.cli.main import run
from barsight.core.records.pairs import StereoFrame
from barsight.core.settings.values import build_settings
from barsight.mapping.settings import MapSettings
from barsight.reconstruction.map_building import nothing_seen
from barsight.result_folder import seal_map
from barsight.yard.events import YardEvent, kept_events, write_events
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.lift_file import read_lifts
from calibration_views import BOARD, SIZE, simulated
from cli_runs import FAST
from result_folders import summary, write_folder

NOTEBOOK: dict[str, Any] = {"stereo": {"method": "sgbm"}, "map": {"cell_m": 0.05}}


WHEN = ("judged_at_ns", "content_sha256")


def lifts_of(folder: Path) -> dict[str, Any]:
    """Read lifts.json, but for when it was judged, which its digest holds too."""
    lifts = read_lifts(folder / "lifts.json")
    return {name: value for name, value in lifts.items() if name not in WHEN}


def test_a_notebook_measures_looks_and_saves(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same files as from the command line, and what they say as arrays."""
    yard = bs.measure(whole, **NOTEBOOK)
    heights = yard.height_map
    assert heights.z_m.shape == heights.sigma_m.shape == (heights.y_m.size, heights.x_m.size)
    np.testing.assert_allclose(np.diff(heights.x_m), 0.05)
    assert np.isfinite(heights.z_m).mean() > 0.5
    contour = yard.contours[0]
    row = int(np.abs(heights.y_m - contour.y_m[0]).argmin())
    known = np.isfinite(contour.z_m)
    near = np.interp(contour.x_m[known], heights.x_m, np.nan_to_num(heights.z_m[row]))
    assert np.median(np.abs(near - contour.z_m[known])) < 0.02
    assert yard.trajectory.position_m.shape == (4, 3)
    assert len(yard.lifts) + len(yard.lifts.refused) <= max(1, len(yard.bundles))
    assert 'src="data:image/png;base64,' in yard._repr_html_()
    saved = yard.save(tmp_path / "saved")
    assert (saved / "report.html").stat().st_size > 100_000
    assert run(["measure", str(whole), "-o", str(tmp_path / "out"), *FAST]) == 0
    for name in ("height.tif", "contour.csv", "trajectory.tum", "bundles.json"):
        assert (saved / name).read_bytes() == (tmp_path / "out" / name).read_bytes(), name
    assert lifts_of(saved) == lifts_of(tmp_path / "out")
    with pytest.raises(bs.BarsightError, match="not empty"):
        yard.save(saved)
    np.testing.assert_array_equal(bs.load(saved).height_map.z_m, heights.z_m)
    assert all(len(repr(one)) < 130 for one in (yard, yard.lifts, heights, contour, yard.trajectory))
    assert all(len(repr(one)) < 130 for one in (*yard.bundles, *yard.lifts.refused))
    folder, copies = yard.folder, [copy.copy(yard), copy.deepcopy(yard)]
    with pytest.raises(bs.BarsightError, match="can't be pickled; save the yard, and load"):
        pickle.dumps(yard)
    del yard, heights
    gc.collect()
    assert [one.trajectory.stamp_ns.size for one in copies] == [4, 4]
    copies.clear()
    gc.collect()
    assert not folder.exists()
    capsys.readouterr()


def test_what_was_reported_in_a_folder_outlives_a_measurement_into_it(whole: Path, tmp_path: Path) -> None:
    """The same recording shows nothing of it a second time either."""
    out = tmp_path / "out"
    yard = bs.measure(whole, **NOTEBOOK)
    yard.save(out)
    from_ns = yard.summary["captured_from_ns"]
    before, since = (YardEvent(from_ns + ns, "lift", 0.5, 0.0, 0.0, 7.0, 0.3) for ns in (0, 1))
    write_events((before, since), out / "events.csv")
    assert run(["measure", str(whole), "-o", str(out), *FAST, "--overwrite"]) == 0
    assert kept_events(out) == (since,) and len(read_lifts(out / "lifts.json")["events"]) == 1
    yard.save(out, overwrite=True)
    assert kept_events(out) == (since,)


def test_a_folder_that_was_measured_anew_is_loaded_again(tmp_path: Path) -> None:
    """Two reads would be of two maps."""
    out = write_folder(tmp_path / "result")
    yard = bs.load(out)
    assert yard.trajectory.stamp_ns.size == 12
    content = summary() | {"captured_from_ns": 1, "captured_to_ns": 2}
    seal_map(content, out)
    (out / "result.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(bs.BarsightError, match="measured anew"):
        _ = yard.height_map
    with pytest.raises(bs.BarsightError, match="measured anew"):
        yard.save(tmp_path / "saved")
    assert not (tmp_path / "saved").exists()
    assert bs.load(out).height_map.z_m.size


def test_a_loaded_yard_stays_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A notebook that changed its directory read another folder, or none."""
    write_folder(tmp_path / "result")
    monkeypatch.chdir(tmp_path)
    yard = bs.load("result")
    monkeypatch.chdir("/")
    assert pickle.loads(pickle.dumps(yard)).trajectory.stamp_ns.size == 12


def test_misspelt_settings_and_missing_recordings_say_so(tmp_path: Path) -> None:
    with pytest.raises(bs.BarsightError, match="no such file"):
        bs.open_recording(tmp_path / "none")
    with pytest.raises(bs.BarsightError, match=r"no result\.json"):
        bs.load(tmp_path)
    packets: Any = bs.Session
    with pytest.raises(bs.BarsightError, match=r"recording is <class .*; give a path, or a"):
        bs.measure(packets)
    with pytest.raises(bs.BarsightError, match="lens is 'round'; choose radtan4, "):
        bs.calibrate_stereo(tmp_path, "checkerboard:9x6:0.025", lens="round")


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"at": "later"}, "at is 'later'; choose now or end"),
        ({"preset": "quick"}, "preset is 'quick'; choose best or fast"),
        ({"self_calibrate": "pitch"}, "self_calibrate is 'pitch'; choose none or yaw"),
        ({"use": ("stereo", "radar")}, "use is 'radar'; choose stereo, imu or crane"),
        ({"use": ("imu",)}, "use must contain stereo: the map is made from the pictures"),
        ({"use": "stereo"}, "use is 'stereo'; give a list"),
        ({"map": 3}, "map is 3; give its fields by name"),
        ({"map": {"cel_m": 0.05}}, "there is no setting map.cel_m; did you mean cell_m?"),
        ({"map": {"cell_m": "x"}}, "map.cell_m is 'x'; give a number"),
        ({"map": {"min_views": True}}, "map.min_views is True; give a whole number"),
        ({"map": {"cell_m": 99}}, "map.cell_m must lie in 0.001...10, not 99.0"),
        ({"map": {"least_shift": 0.1}}, "map.least_shift is called map.min_shift now"),
        ({"lift": {"stanchions": [(1, 2)]}}, "lift.stanchions has 2 values; give 3"),
        ({"motion": {"estimator": "gtsam"}}, "motion.estimator is 'gtsam'; choose fused, live, "),
        ({"recording": {"rig": 3}}, "recording.rig is 3; give a path"),
        ({"magnet": "no.toml"}, "no.toml: no such file; check the path given as magnet"),
    ],
)
def test_a_setting_that_cannot_be_is_named(whole: Path, settings: dict[str, Any], line: str) -> None:
    with pytest.raises(bs.BarsightError) as caught:
        bs.measure(whole, **settings)
    assert str(caught.value).startswith(line)


FLAT = np.zeros((40, 60), np.uint8)


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: bs.disparity(FLAT, FLAT, range_px=(1,)), "range_px has 1 value; give 2"),
        (lambda: bs.disparity(FLAT, FLAT, range_px=(0, 8, 9)), "range_px has 3 values; give 2"),
        (lambda: bs.disparity(FLAT, FLAT, range_px=3), "range_px is 3; give a list"),
        (lambda: bs.disparity(FLAT, FLAT, range_px=np.zeros((2, 2))), "range_px is array("),
        (lambda: bs.disparity(FLAT, FLAT, range_px=(np.nan, 8)), "range_px is nan; give a whole number"),
        (
            lambda: bs.disparity(FLAT, FLAT, range_px=(0, 8), max_disparity_px=9),
            "range_px and max_disparity_px are given; leave one of them out",
        ),
        (lambda: bs.disparity(FLAT, FLAT, rig=3), "rig is 3; give a path"),
        (lambda: bs.disparity(PurePosixPath("none.png"), FLAT), "none.png: no such file"),
        (lambda: bs.disparity(None, FLAT), "left: has the shape (); "),
        (lambda: bs.disparity(FLAT, np.zeros(0, np.uint8)), "right: has the shape (0,); "),
        (lambda: bs.open_recording(None), "path is None; give a path"),
        (lambda: bs.open_recording("a\0b"), "path is 'a\\x00b'; give a path without a NUL character"),
        (lambda: bs.open_recording("x" * 300), "path has a file name of more than 255 bytes"),
        (lambda: bs.load(np.zeros(3)), "folder is array("),
        (lambda: bs.Yard(3), "folder is 3; give a path"),
        (lambda: bs.measure(3), "recording is 3; give a path"),
        (lambda: bs.measure(["none", None]), "recording is None; give a path"),
        (lambda: bs.measure(b"none"), "recording is b'none'; give a path"),
        (lambda: bs.measure("none", magnet=3), "magnet is 3; give a path"),
        (lambda: list(bs.packets("none")), "recording is 'none'; give what open_recording(PATH) returns"),
        (lambda: bs.calibrate_stereo("none", None), "board is None; give text in quotes"),
        (lambda: bs.calibrate_stereo([], "checkerboard:9x6:0.025"), "pictures is []; give a path"),
        (
            lambda: bs.calibrate_stereo("none", "checkerboard:9x6:0.025", max_views=0),
            "max_views is 0; give 6 or more",
        ),
        (
            lambda: bs.calibrate_stereo("none", "checkerboard:9x6:0.025", lens=np.zeros(2)),
            "lens is array([0., 0.]); choose radtan4, ",
        ),
    ],
)  # fmt: skip
def test_a_malformed_argument_is_named(call: Callable[[], Any], line: str) -> None:
    """They ended in an IndexError, a TypeError or an AttributeError of what they reached."""
    with pytest.raises(bs.BarsightError) as caught:
        call()
    assert str(caught.value).startswith(line)


def test_settings_made_by_hand_are_checked_too() -> None:
    """Their types are what a checker of types sees; at run time they are held to it as well."""
    with pytest.raises(bs.BarsightError, match="preset is 'quick'; choose best or fast"):
        bs.MeasureSettings(preset="quick")  # type: ignore[arg-type]
    with pytest.raises(bs.BarsightError, match="contours is 'drawn'; choose fused or paper"):
        bs.MeasureSettings(map=MapSettings(contours="drawn"))  # type: ignore[arg-type]
    with pytest.raises(bs.BarsightError, match=r"map is \{'cell_m': 0.02\}; give a MapSettings"):
        bs.MeasureSettings(map={"cell_m": 0.02})  # type: ignore[arg-type]


def test_settings_take_numbers_and_paths_of_any_kind() -> None:
    """NumPy's numbers, whole ones for others, lists, texts for paths, records that are made already."""
    given = {
        "map": {"cell_m": np.float32(0.5), "min_views": np.int64(3), "profile_y_m": [1, 2.5]},
        "recording": {"rig": "rig.yaml"}, "lift": LiftSettings(bundles=2),
    }  # fmt: skip
    built = build_settings(given, bs.MeasureSettings)
    assert built.map == MapSettings(cell_m=0.5, min_views=3, profile_y_m=(1.0, 2.5))
    assert [type(one) for one in (built.map.cell_m, built.map.min_views)] == [float, int]
    assert (built.recording.rig, built.lift.bundles) == (Path("rig.yaml"), 2)


def test_a_disparity_of_two_arrays() -> None:
    rng = np.random.default_rng(1)
    scene = rng.integers(0, 255, (80, 240), np.uint8)
    found = bs.disparity(scene[:, :200], scene[:, 12:212], range_px=(0, 32), method="sgbm")
    inner = found.disparity_px[10:-10, 60:-20]
    assert np.isfinite(inner).mean() > 0.9
    assert abs(float(np.nanmedian(inner)) - 12) < 0.1
    wide = scene.astype(np.uint16) * 257
    same: Any = np.dstack([scene] * 3)[:, 12:212], wide[:, :200]
    again = bs.disparity(same[1], same[0], range_px=(0, 32), method="sgbm")
    np.testing.assert_array_equal(again.disparity_px, found.disparity_px)
    with pytest.raises(bs.BarsightError, match="float64 pixels; 8 or 16 bits are needed; give uint8"):
        bs.disparity(scene / 255, same[0])


def test_a_calibration_that_must_be_redone_says_so_and_is_saved_with_its_covariance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rig alone has no sigma: maps stated the default's, a quarter of it."""
    found = simulated(1, count=4), (SIZE, SIZE), []
    monkeypatch.setattr("barsight.api.views_from_pictures", lambda *_: found)
    with pytest.warns(UserWarning, match=r"redo the calibration, don't measure with it: views .* 4 \(redo\)"):
        calibration = bs.calibrate_stereo(tmp_path, str(BOARD))
    calibration.save(tmp_path / "rig.yaml")
    names, covariance = read_covariance(tmp_path / "rig.yaml") or ((), np.empty(0))
    assert names == calibration.parameter_names
    np.testing.assert_array_equal(covariance, calibration.covariance)


def test_without_xarray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    one = np.zeros((2, 3), np.float32)
    heights = bs.HeightMap(1.0, 2.0, 0.5, one, one, one, one.astype(np.uint8))
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "xarray", None)
        with pytest.raises(bs.BarsightError, match=r"barsight\[notebook\]"):
            heights.to_xarray()
    dataset = pytest.importorskip("xarray") and heights.to_xarray()
    assert dataset.z_m.sel(x=2.0, y=2.5).item() == 0


ELSEWHERE = """
import os, signal, sys
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None
for home, names in (
    (os, "geteuid getuid O_NONBLOCK O_CLOEXEC O_DIRECTORY O_NOFOLLOW sched_getaffinity sysconf"),
    (signal, "SIGHUP SIGALRM SIGUSR1 setitimer"),
):
    for name in names.split():
        delattr(home, name)
from pathlib import Path
import barsight as bs
from barsight.calibration.files.rig_file import read_covariance
from barsight.cli.main import main
recording, result = sys.argv[1:]
opened = bs.open_recording(recording)
pair = next(iter(opened.frames()))
yard = bs.load(result)
print(len(opened.index.stamps_ns), pair.left.shape, yard.height_map.z_m.shape, len(yard.contours))
try:
    yard.save(Path(result) / "saved")
except bs.BarsightError as error:
    print(error)
sys.argv = ["barsight", "info", recording]
main()
"""
"""A system without what only Unix has, as far as Linux can play it."""


def test_recordings_and_results_are_read_without_unix(whole: Path, tmp_path: Path) -> None:
    result = write_folder(tmp_path / "result")
    told = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, str(whole), str(result)],
        capture_output=True, text=True,
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    read, refused, *info = told.stdout.splitlines()
    recording, yard = bs.open_recording(whole), bs.load(result)
    pair = next(iter(recording.frames()))
    assert isinstance(pair, StereoFrame)
    assert read == (
        f"{len(recording.index.stamps_ns)} {pair.left.shape} {yard.height_map.z_m.shape} {len(yard.contours)}"
    )
    assert refused.endswith("can't be locked on this system; write it on Linux or macOS")
    assert any("euroc" in line for line in info)


def test_importing_loads_nothing_heavy() -> None:
    code = "import sys; import barsight as bs{more}; print({names})"
    light = code.format(more="", names="[n for n in ('numpy', 'cv2', 'numba', 'scipy') if n in sys.modules]")
    assert subprocess.check_output([sys.executable, "-c", light], text=True).strip() == "[]"
    commands = ", barsight.cli.bench.command, barsight.cli.measure"
    every = code.format(more=commands, names="[n for n in bs.__all__ if getattr(bs, n) is None]")
    assert subprocess.check_output([sys.executable, "-c", every], text=True).strip() == "[]"
    assert dir(bs) == sorted(bs.__all__)
    with pytest.raises(AttributeError, match="no attribute 'mesure'"):
        bs.mesure  # noqa: B018


def test_where_nothing_is_seen_cells_that_were_set_are_named() -> None:
    told = [str(nothing_seen(Path("way"), 2, MapSettings(cell_m=cell))) for cell in (None, 10.0)]
    assert told[0] == "way: no place was seen by 2 frames; lower map.min_views"
    assert told[1] == f"{told[0]}, or choose smaller cells than map.cell_m = 10 m"
