"""Make the whole files that the mutators damage: a tiny yard, its recording in each format, its results."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np

from barsight.acceptance.commissioning import GuidedStep, begin, walk
from barsight.acceptance.watch.record import Approval, WatchedFigure, WatchedSurvey, WatchRecord, write_watch
from barsight.calibration.files.euroc import read_rig
from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.files.yaml_document import write_document
from barsight.cli.main import run
from barsight.core.files import atomic_directory
from barsight.core.reading.sealed_json import write_sealed
from barsight.fleet.ledger import HeldRecording, claim, park, publish
from barsight.fleet.objects import open_objects
from barsight.fleet.records import find_version, read_tasks
from barsight.plant.opcua.security.access import add_user
from barsight.plant.telegram import IN_MAGIC, VERSION, pack
from barsight.recording.open import open_recording
from barsight.result_folder import file_digest
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.simulate import simulate
from barsight.store.opening import open_store
from barsight.yard.magnet.description import example_magnet
from fuzz.mutators import reseal_folder

sys.path.append(str(Path(__file__).parents[1] / "tests"))
import result_folders
import yard_folders

TINY = SimulationSettings(
    length_m=1.5, frames=4, seed=3, camera=CameraSettings(width_px=320, height_px=256, focal_px=312.5),
    yard=YardSettings(max_layers=2),
)  # fmt: skip
BAGS = {"mcap": "ros2-mcap", "sqlite": "ros2-sqlite3", "ros1": "ros1"}
START_NS = 1_700_000_000_000_000_000


def make_seeds(folder: Path) -> None:
    """Fill `folder`; it appears whole or not at all."""
    with atomic_directory(folder) as made:
        simulate(made / "euroc", TINY)
        for name, kind in BAGS.items():
            _done(["convert", str(made / "euroc"), "-o", str(made / name), "--to", kind])
        write_kitti(made / "kitti", made / "euroc")
        _files(made)
        for name, shift_m in (("out", 0.0), ("old", 0.1)):
            write_results(made / name, shift_m)
            measured_from(made / name, made / "euroc")
            _done(["lifts", str(made / name), "--magnet", str(made / "magnet.toml"), "--at", "end"])
        _fleet(made)
        _acceptance(made)


def _done(command: list[str]) -> None:
    code = run(command)
    if code:
        raise RuntimeError(f"barsight {' '.join(command)} ended with {code}")


def write_results(folder: Path, shift_m: float) -> None:
    """Write what measuring leaves: a yard of two bundles, with all the files that a page shows."""
    yard_folders.write_folder(folder, shift_m=shift_m)
    more = folder.with_name("more")
    result_folders.write_folder(more)
    for name in ("cloud.ply", "contour.csv", "laser.csv", "trajectory.tum", "preview.png"):
        shutil.copyfile(more / name, folder / name)
    shutil.rmtree(more)
    reseal_folder(folder)


def measured_from(folder: Path, recording: Path) -> None:
    """Make a result one of this recording: its poses at the recording's stamps, its digests."""
    opened = open_recording(recording)
    poses = [f"{stamp / 1e9:.9f} {k}.0 0.15 8.0 1 0 0 0" for k, stamp in enumerate(opened.index.stamps_ns)]
    (folder / "trajectory.tum").write_text("\n".join(poses) + "\n")
    result = json.loads((folder / "result.json").read_text())
    result["hashes"]["inputs"] = opened.digests()
    result["recording"]["path"] = recording.name
    result["configuration"] = {
        "stereo": {"calibration_sigma_px": 0.1},
        "bundles": {"shared_lateral_m": 0.002, "shared_height_m": 0.001},
    }
    stamps = [int(stamp) for stamp in opened.index.stamps_ns]
    count = len(stamps)
    result["travel"] = {
        "place_m": [[float(k), 0.15] for k in range(count)], "sigma_m": [[1e-3, 2e-3, 1e-3]] * count,
        "off_m": [1e-3] * count, "refused_m": [], "reach_m": 5.0, "stamp_ns": stamps,
        "measured": [True] * count, "sure_reach_m": 3.0, "eye_z_m": 8.0, "pixel_rad": 8e-4,
        "pass_number": [],
    }  # fmt: skip
    (folder / "result.json").write_text(json.dumps(result))
    reseal_folder(folder)


def write_kitti(folder: Path, euroc: Path) -> None:
    for camera in (0, 1):
        (folder / f"image_{camera}").mkdir(parents=True)
        pictures = sorted((euroc / "mav0" / f"cam{camera}" / "data").glob("*.png"))
        for k, path in enumerate(pictures):
            shutil.copyfile(path, folder / f"image_{camera}" / f"{k:06d}.png")
    rows = ("312.5 0 159.5 0 0 312.5 127.5 0 0 0 1 0", "312.5 0 159.5 -150 0 312.5 127.5 0 0 0 1 0")
    (folder / "calib.txt").write_text("".join(f"P{k}: {row}\n" for k, row in enumerate(rows)))
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(len(pictures))))


def _files(made: Path) -> None:
    rig = read_rig(made / "euroc" / "mav0")
    write_rig_file(made / "rig.yaml", rig)
    for name, to in (("camchain.yaml", "kalibr"), ("opencv.yaml", "opencv"), ("opencv.xml", "opencv")):
        _done(["calibrate", "export", str(made / "rig.yaml"), "-o", str(made / name), "--to", to])
    (made / "magnet.toml").write_text(example_magnet(), encoding="utf-8")
    _places(made)
    (made / "settings.toml").write_text(
        'preset = "best"\nuse = ["stereo", "crane"]\n[map]\ncell_m = 0.05\n[stereo]\nmethod = "sgbm"\n'
    )
    (made / "stock.csv").write_text("name,x_m,y_m,length_m,bars\nA,0.5,0.1,2.0,12\nB,0.9,0.4,2.0,8\n")
    stock = [{"name": "A", "x_m": 0.5, "y_m": 0.1, "bars": 12}, {"name": "B", "x_m": 0.9, "y_m": 0.4}]
    (made / "stock.json").write_text(json.dumps({"bundles": stock}, indent=1))
    (made / "events.csv").write_text(
        "stamp_ns,kind,x_m,y_m,yaw_deg,length_m,width_m\n"
        f"{START_NS},lift,0.5,0.1,0.0,2.0,0.3\n{START_NS + 5},magnet,0.9,0.4,90.0,1.0,0.5\n"
    )
    draw = np.random.default_rng(1)
    places = draw.uniform(0, 10, (6, 3))
    rows = [",".join([f"T{k}", *(f"{v:.4f}" for v in (*p, *(p + 0.5)))]) for k, p in enumerate(places)]
    (made / "targets.csv").write_text("name,yard_x,yard_y,yard_z,x,y,z\n" + "\n".join(rows) + "\n")
    gyro, accel = draw.normal(0, 1e-3, (4000, 3)), draw.normal((0, 0, 9.81), 1e-2, (4000, 3))
    lines = [
        f"{START_NS + 10_000_000 * k},{','.join(f'{v:.6f}' for v in (*w, *a))}"
        for k, (w, a) in enumerate(zip(gyro, accel, strict=True))
    ]
    (made / "imu.csv").write_text("#t,wx,wy,wz,ax,ay,az\n" + "\n".join(lines) + "\n")
    _corners(made / "corners")
    for name, camera in (("left.png", "cam0"), ("right.png", "cam1")):
        first = min((made / "euroc" / "mav0" / camera / "data").glob("*.png"))
        shutil.copyfile(first, made / name)
    for suffix in (".jpg", ".tif", ".bmp", ".pgm"):
        picture = cv2.imread(str(made / "left.png"), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        cv2.imwrite(str(made / f"left{suffix}"), picture)


def _places(made: Path) -> None:
    """Write what a crane and its plant are described with."""
    write_document(
        made / "yard.yaml",
        {
            "barsight_yard": 1,
            "yard_from_encoders": np.eye(4).tolist(),
            "covariance": (1e-6 * np.eye(6)).tolist(),
            "R_yard_body": np.diag([1.0, -1.0, -1.0]).tolist(),
            "calibration_id": "0123456789abcdef",
            "doubts": ["few points"],
        },
    )
    (made / "crane.toml").write_text(
        'calibration = "rig.yaml"\n[cameras]\nserials = ["1", "2"]\nrate_hz = 30\n[encoders]\nport = 5602\n'
        "rate_hz = 20\np_crane_body_m = [0.0, 0.3, -1.2]\nR_yard_body = [1, 0, 0, 0, -1, 0, 0, 0, -1]\n"
        "position_std_m = 0.002\n"
    )
    (made / "plant.toml").write_text(
        '[store]\nurl = "sqlite:///y.db"\nmagnet_steps_kg = [1000.0, 3000.0]\n[telegram]\nport = 2000\n'
    )
    (made / "users.toml").write_text(
        '[store]\nurl = "sqlite:///y.db"\nmagnet_steps_kg = [1000.0]\n[opcua]\nfolder = "opcua"\n'
        'users = "users.json"\n'
    )
    (made / "telegram.bin").write_bytes(pack("in", {"magic": IN_MAGIC, "version": VERSION, "life": 7}))


def _acceptance(made: Path) -> None:
    """Write what commissioning and service keep of a rig."""
    touch = {"group": "touch_mm", "decision": "passed", "uncertainty": {"sigma": 1.0}}
    rows = [{**touch, "name": f"touch {k}: {axis}", "error": 1.5 + k} for k in range(3) for axis in "xyz"]
    ids = {"calibration_id": "c", "yard_frame_id": "none"}
    write_sealed(
        {"schema_version": 1, "quantities": rows, "plan": {}, "causes": [], **ids}, made / "certificate.json"
    )
    figures = tuple(WatchedFigure(name, 0.1, 0.02) for name in ("yaw / deg", "baseline / mm"))
    surveys = tuple(WatchedSurvey(f"r{k}", f"id{k}", "c", figures) for k in range(12))
    approval = Approval("ann", "new", "2026-01-01T00:00:00+00:00", "c", 2)
    write_watch(WatchRecord(surveys, (approval,)), made / "watch.json")
    (made / "plan.toml").write_text(
        'yard = "Y"\n[[plate]]\nname = "P1"\nx_m = 1.0\ny_m = 2.0\nz_m = 0.02\nsize_m = [0.5, 0.5]\n'
        '[[sphere]]\nname = "S1"\nx_m = 0.5\ny_m = 0.5\nz_m = 0.3\ndiameter_m = 0.2\nplace_sigma_m = 0.001\n'
    )
    add_user(made / "users.json", "ann", "operator", "a long password")
    folder = made / "commission"
    begin(folder)
    waits = GuidedStep("cameras", ("board",), ("rig.yaml",), "pictures", lambda: "done")
    (folder / "given").write_text("x")
    walk(folder, (GuidedStep("first", ("given",), ("given",), "", lambda: "done"), waits))


def _fleet(made: Path) -> None:
    """Write an archive of a recording and a survey, and results of two versions as a run leaves them: one
    recording published under both, one parked, one under way.
    """
    archive, kept = made / "archive", made / "fleet"
    for name in ("one", "survey/first", "two"):
        (archive / name / "mav0").mkdir(parents=True)
        (archive / name / "mav0" / "body.yaml").write_text(f"name: {name}\n")
    (archive / "survey" / "survey.json").write_text('{"passes": ["first"]}')
    (made / "fleet.toml").write_text(
        'yard = "yard.yaml"\n[bundles]\nstock_list = "stock.csv"\n[map]\ncell_m = 0.05\n'
    )
    store = f"sqlite:///{kept}/yard.db"
    results = open_objects(str(kept), create=True)
    for out, flag, file in (("out", "--rig", "rig.yaml"), ("old", "--magnet", "magnet.toml")):
        words = ["--results", str(kept), "--store", store, flag, str(made / file)]
        _done(["fleet", "plan", str(archive), *words])
        with open_store(store) as opened, opened.reading() as connection:
            keys = [task.key for task in read_tasks(connection, find_version(connection, None))]
        told = {}
        for path in (made / out).iterdir():
            results.write(f"files/{keys[0]}/t/{path.name}", path)
            told[path.name] = {"bytes": path.stat().st_size, "sha256": file_digest(path)}
        note = {"measured_s": 1.0, "whole_s": 2.0, "peak_bytes": 1, "files": told}
        publish(results, HeldRecording(keys[0], 1, "t"), note)
        park(results, keys[1], "refused: exit code 3", 3)
        if out == "old":
            claim(results, keys[2], 60.0)
        else:
            park(results, keys[2], "timeout: did not end in 5 s", 3)


def _corners(folder: Path) -> None:
    folder.mkdir()
    kind = [
        ("stamp_ns", "i8"),
        ("tag", "i4"),
        ("corner", "i4"),
        ("u", "f8"),
        ("v", "f8"),
        ("x", "f8"),
        ("y", "f8"),
    ]
    rows = np.zeros(96, kind)
    rows["stamp_ns"] = np.repeat(START_NS + 100_000_000 * np.arange(4), 24)
    rows["tag"], rows["corner"] = np.tile(np.arange(24) // 4, 4), np.tile(np.arange(24) % 4, 4)
    rows["u"], rows["v"] = 10.0 + 12 * rows["tag"], 20.0 + 9 * rows["corner"]
    for camera in (0, 1):
        np.savez(folder / f"cam{camera}_detections.npz", detections=rows)
