"""List every command that writes, with what it reads and what must appear whole or not at all."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from fuzz.targets import Call, Target, compare_versions, promote_version, run_words


def exec_words(*words: str) -> Call:
    """Run a command in a fresh interpreter in place of this fork: a kernel whose loops run in parallel can't
    run in a fork of a process that loaded one.
    """

    def call(folder: Path) -> int:
        filled = [word.replace("FOLDER", str(folder)) for word in words]
        os.execv(sys.executable, [sys.executable, "-m", "barsight", *filled])

    return call


def typed_words(text: str, *words: str) -> Call:
    """Run a command that asks for a text on the standard input."""
    call = run_words(*words)

    def typed(folder: Path) -> int:
        read, write = os.pipe()
        os.write(write, text.encode())
        os.close(write)
        os.dup2(read, 0)
        sys.stdin = os.fdopen(0, closefd=False)
        return call(folder)

    return typed


TINY_YARD = (
    "--length-m", "1.2", "--frames", "3", "--camera.width-px", "160", "--camera.height-px", "128",
    "--camera.focal-px", "156",
)  # fmt: skip
MEASURE = ("measure", "FOLDER/euroc", "-o", "FOLDER/made", "--stereo.method", "sgbm", "--map.cell-m", "0.05")
PAIR = ("disparity", "FOLDER/left.png", "FOLDER/right.png", "--method", "sgbm", "--rig", "FOLDER/rig.yaml")
BOARD = "checkerboard:9x6:0.03"
WRITERS = (
    *(
        Target(
            f"convert {to}", ("euroc",), (),
            run_words("convert", "FOLDER/euroc", "-o", "FOLDER/made", "--to", to), ("made",),
        ) for to in ("euroc", "ros1", "ros2-mcap", "ros2-sqlite3")
    ),
    *(
        Target(
            f"export {kind}", ("out",), (), run_words("export", "FOLDER/out", f"FOLDER/made.{kind}"),
            (f"made.{kind}",),
        ) for kind in ("ply", "pcd", "las", "laz", "e57", "csv", "tif")
    ),
    *(
        Target(
            f"disparity {kind}", ("left.png", "right.png", "rig.yaml"), (),
            run_words(*PAIR, "-o", f"FOLDER/made.{kind}"), (f"made.{kind}",),
        ) for kind in ("pfm", "png", "tif")
    ),
    Target("report", ("out",), (), run_words("report", "FOLDER/out"), ("out",)),
    Target(
        "lifts", ("out", "magnet.toml"), (),
        run_words("lifts", "FOLDER/out", "--magnet", "FOLDER/magnet.toml", "--at", "end"), ("out",),
    ),
    Target(
        "explain", ("out",), (), run_words("explain", "FOLDER/out", "1", "-o", "FOLDER/made.html"),
        ("made.html",),
    ),
    Target(
        "compare", ("out", "old"), (),
        run_words("compare", "FOLDER/out", "FOLDER/old", "--json", "FOLDER/made.json"), ("made.json",),
    ),
    Target(
        "labels", ("euroc", "out"), (), run_words("labels", "FOLDER/euroc", "FOLDER/out"), ("out",),
        warm=False,
    ),
    Target(
        "budget", ("euroc", "out"), (), run_words("budget", "FOLDER/out", "-o", "FOLDER/made.json"),
        ("made.json",), warm=False,
    ),
    Target("store add", ("out",), (), run_words("store", "add", "sqlite:///FOLDER/yard.db", "FOLDER/out")),
    Target(
        "store user", ("fleet",), (),
        typed_words(
            "a long password\n", "store", "user", "sqlite:///FOLDER/fleet/yard.db", "ann", "--role",
            "engineer",
        ),
    ),
    Target(
        "fleet plan", ("archive", "magnet.toml"), (),
        run_words(
            "fleet", "plan", "FOLDER/archive", "--results", "FOLDER/made", "--store", "sqlite:///FOLDER/yard.db",
            "--magnet", "FOLDER/magnet.toml",
        ), warm=False,
    ),
    Target("fleet compare", ("fleet",), (), compare_versions, ("made",), warm=False),
    Target("fleet promote", ("fleet",), (), promote_version, warm=False),
    Target("plant scl", (), (), run_words("plant", "scl", "-o", "FOLDER/made.scl"), ("made.scl",)),
    Target(
        "plant user", ("users.toml",), (),
        typed_words("a long password\n", "plant", "user", "ann", "--config", "FOLDER/users.toml"),
        ("users.json",),
    ),
    Target(
        "calibrate board", (), (),
        run_words("calibrate", "board", "--board", BOARD, "-o", "FOLDER/made.png", "--dpi", "50"),
        ("made.png",),
    ),
    Target(
        "calibrate yard", ("targets.csv",), (),
        run_words("calibrate", "yard", "FOLDER/targets.csv", "-o", "FOLDER/made.yaml"),
        ("made.yaml", "made.html", "made.json"),
    ),
    Target(
        "calibrate magnet", ("certificate.json", "magnet.toml"), (),
        run_words(
            "calibrate", "magnet", "FOLDER/certificate.json", "--magnet", "FOLDER/magnet.toml", "-o",
            "FOLDER/made.toml",
        ),
        ("made.toml",),
    ),
    Target(
        "calibrate imu-noise", ("imu.csv",), (),
        run_words("calibrate", "imu-noise", "FOLDER/imu.csv", "-o", "FOLDER/made.yaml"),
        ("made.yaml", "made.html", "made.json"),
    ),
    Target(
        "calibrate export", ("rig.yaml",), (),
        run_words("calibrate", "export", "FOLDER/rig.yaml", "-o", "FOLDER/made.yaml", "--to", "opencv"),
        ("made.yaml",),
    ),
    Target(
        "calibrate check", ("euroc",), (),
        run_words("calibrate", "check", "FOLDER/euroc", "-o", "FOLDER/made.json"), ("made.json", "made.html"),
        warm=False,
    ),
    Target(
        "verify", ("euroc",), (), run_words("verify", "FOLDER/euroc", "--record", "FOLDER/made.json"),
        ("made.json",), warm=False,
    ),
    Target("measure", ("euroc",), (), run_words(*MEASURE), ("made",), warm=False),
    Target("measure --resume", ("euroc",), (), run_words(*MEASURE, "--resume"), ("made",), warm=False),
    Target(
        "odometry", ("euroc",), (), run_words("odometry", "FOLDER/euroc", "-o", "FOLDER/made"), ("made",),
        warm=False,
    ),
    Target("simulate", (), (), exec_words("simulate", "FOLDER/made", *TINY_YARD), ("made",), warm=False),
)  # fmt: skip
