"""List what is attacked: a seed, the files in it that are damaged, and the command that reads them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from barsight.cli.main import run_and_print

Call = Callable[[Path], int]
SKIPPED = ("state_groundtruth_estimate0", "truth")


@dataclass(frozen=True)
class Target:
    """seeds: names below the seeds' folder that are copied. damaged: glob patterns of what is damaged.
    call: what reads them, given the folder of the copies. outputs: what must not be left or changed where it
    fails. weight: its share of the turns. warm: it leaves no thread behind, so that the parent may run it
    once for what its forks need.
    """

    name: str
    seeds: tuple[str, ...]
    damaged: tuple[str, ...]
    call: Call
    outputs: tuple[str, ...] = ()
    weight: float = 1.0
    warm: bool = True

    def copy(self, seeds: Path, scratch: Path) -> None:
        """Copy the seeds into an empty folder."""
        for name in self.seeds:
            source = seeds / name
            if source.is_dir():
                shutil.copytree(source, scratch / name)
            else:
                shutil.copyfile(source, scratch / name)

    def files(self, scratch: Path) -> list[Path]:
        """List the files that may be damaged."""
        found = {path for pattern in self.damaged for path in scratch.glob(pattern) if path.is_file()}
        return sorted(path for path in found if not set(SKIPPED) & set(path.parts))


def run_words(*words: str) -> Call:
    """Run a command of the command line; FOLDER/ in its words is the folder of the copies."""
    return lambda folder: run_and_print([word.replace("FOLDER", str(folder)) for word in words])


def _magnet(folder: Path) -> int:
    from barsight.yard.magnet.description import load_magnet

    load_magnet(folder / "magnet.toml")
    return 0


def _yard_frame(folder: Path) -> int:
    from barsight.registration.yard_file import read_yard_file

    read_yard_file(folder / "yard.yaml")
    return 0


def _crane(folder: Path) -> int:
    from barsight.live.settings import read_crane

    read_crane(folder / "crane.toml").rig()
    return 0


def _plant(folder: Path) -> int:
    from barsight.plant.settings import read_plant

    read_plant(folder / "plant.toml")
    return 0


def _telegram(folder: Path) -> int:
    from barsight.core.errors import Failed, InputError
    from barsight.core.reading.bounded_reading import read_bytes
    from barsight.plant.telegram import unpack

    path = folder / "telegram.bin"
    found = unpack("in", read_bytes(path, 1000))
    if isinstance(found, Failed):
        raise InputError(path, found.reason, "send what telegram.toml says")
    return 0


def _stock(name: str) -> Call:
    def call(folder: Path) -> int:
        from barsight.yard.inventory.stock_list import read_stock

        read_stock(folder / name)
        return 0

    return call


def _detections(folder: Path) -> int:
    from barsight.recording.base import RecordingSettings
    from barsight.recording.info import describe_recording
    from barsight.recording.open import open_recording

    recording = open_recording(folder / "corners", RecordingSettings(rig=folder / "rig.yaml"))
    describe_recording(recording)
    return 0


def _view(folder: Path) -> int:
    from barsight.viewer.view import serving

    with serving(folder / "out", 0):
        return 0


def _convert(name: str, to: str) -> Target:
    call = run_words("convert", f"FOLDER/{name}", "-o", "FOLDER/made", "--to", to)
    return Target(f"convert {name}", (name,), (f"{name}/**/*",), call, ("made",), 1.0)


def _info(name: str, weight: float = 1.0) -> Target:
    return Target(f"info {name}", (name,), (f"{name}/**/*",), run_words("info", f"FOLDER/{name}"), (), weight)


def _rig(name: str) -> Target:
    call = run_words("calibrate", "export", f"FOLDER/{name}", "-o", "FOLDER/made.yaml", "--to", "kalibr")
    return Target(f"rig {name}", (name,), (name,), call, ("made.yaml",), 1.5)


def _watch(folder: Path) -> int:
    from barsight.acceptance.watch.charts import control_charts
    from barsight.acceptance.watch.record import read_watch

    control_charts(read_watch(folder / "watch.json").since_approval)
    return 0


def _plan(folder: Path) -> int:
    from barsight.artefacts.plan import read_plan

    read_plan(folder / "plan.toml")
    return 0


def _users(folder: Path) -> int:
    from barsight.plant.opcua.security.access import read_users

    read_users(folder / "users.json")
    return 0


def compare_versions(folder: Path) -> int:
    """Compare the two versions of the fleet's folder."""
    first, second = sorted(path.name for path in (folder / "fleet/versions").iterdir())
    store = f"sqlite:///{folder}/fleet/yard.db"
    words = ("--results", f"{folder}/fleet", "--store", store, "-o", f"{folder}/made")
    return run_and_print(["fleet", "compare", first, second, *words])


def promote_version(folder: Path) -> int:
    """Promote the version of the fleet's folder that ran to its end."""
    first = next(path.parent.name for path in (folder / "fleet/versions").glob("*/rig.yaml"))
    store = f"sqlite:///{folder}/fleet/yard.db"
    words = ("--results", f"{folder}/fleet", "--store", store, "--into", f"{folder}/made")
    return run_and_print(["fleet", "promote", first, *words])


RESULT = ("out/*",)
FLEET = (
    "fleet/results/**/*",
    "fleet/files/**/*.json",
    "fleet/parked/*",
    "fleet/claims/**/*",
    "fleet/yard.db",
)
TARGETS = (
    _info("euroc", 4), _info("mcap", 2), _info("sqlite", 2), _info("ros1", 2), _info("kitti", 3),
    _convert("euroc", "ros2-mcap"), _convert("kitti", "euroc"), _convert("mcap", "euroc"),
    _convert("sqlite", "ros1"), _convert("ros1", "ros2-sqlite3"),
    _rig("rig.yaml"), _rig("camchain.yaml"), _rig("opencv.yaml"), _rig("opencv.xml"),
    Target("corners", ("corners", "rig.yaml"), ("corners/*",), _detections, (), 1.5),
    Target("magnet", ("magnet.toml",), ("magnet.toml",), _magnet, (), 2),
    Target("yard frame", ("yard.yaml",), ("yard.yaml",), _yard_frame, (), 1.5),
    Target("crane", ("crane.toml", "rig.yaml"), ("crane.toml",), _crane, (), 1.5),
    Target("plant", ("plant.toml",), ("plant.toml",), _plant),
    Target("telegram", ("telegram.bin",), ("telegram.bin",), _telegram, (), 0.5),
    Target("stock csv", ("stock.csv",), ("stock.csv",), _stock("stock.csv"), (), 1.5),
    Target("stock json", ("stock.json",), ("stock.json",), _stock("stock.json"), (), 1.5),
    Target(
        "settings", ("settings.toml",), ("settings.toml",),
        run_words("measure", "FOLDER/none", "-o", "FOLDER/made", "--config", "FOLDER/settings.toml"),
        ("made",), 2,
    ),
    Target(
        "targets", ("targets.csv",), ("targets.csv",),
        run_words("calibrate", "yard", "FOLDER/targets.csv", "-o", "FOLDER/made.yaml"),
        ("made.yaml", "made.html", "made.json"), 1,
    ),
    Target(
        "imu log", ("imu.csv",), ("imu.csv",),
        run_words("calibrate", "imu-noise", "FOLDER/imu.csv", "-o", "FOLDER/made.yaml"),
        ("made.yaml", "made.html", "made.json"), 0.5,
    ),
    *(
        Target(
            f"picture {suffix}", (f"left{suffix}", "right.png", "rig.yaml"), (f"left{suffix}",),
            run_words("disparity", f"FOLDER/left{suffix}", "FOLDER/right.png", "-o", "FOLDER/made.pfm",
                     "--method", "sgbm", "--rig", "FOLDER/rig.yaml"),
            ("made.pfm",), 0.6,
        ) for suffix in (".png", ".jpg", ".tif", ".bmp", ".pgm")
    ),
    Target("score", ("euroc", "out"), (*RESULT, "euroc/truth/*"),
        run_words("score", "FOLDER/euroc", "FOLDER/out")),
    Target("report", ("out",), RESULT, run_words("report", "FOLDER/out"), ("out",), 1),
    Target(
        "lifts", ("out", "magnet.toml"), RESULT,
        run_words("lifts", "FOLDER/out", "--magnet", "FOLDER/magnet.toml", "--at", "end"), ("out",), 1,
    ),
    Target(
        "events", ("out", "events.csv"), ("events.csv",),
        run_words("lifts", "FOLDER/out", "--events", "FOLDER/events.csv", "--at", "end"), ("out",), 0.5,
    ),
    Target("explain", ("out",), RESULT, run_words("explain", "FOLDER/out", "1"), ("out",), 1),
    Target("compare", ("out", "old"), RESULT, run_words("compare", "FOLDER/out", "FOLDER/old"), (), 1),
    Target(
        "store", ("out",), RESULT, run_words("store", "add", "sqlite:///FOLDER/yard.db", "FOLDER/out"), (), 1
    ),
    Target(
        "labels", ("euroc", "out"), (*RESULT, "euroc/mav0/**/*"),
        run_words("labels", "FOLDER/euroc", "FOLDER/out"), ("out",), 0.2
    ),
    Target(
        "fleet plan", ("archive", "fleet.toml", "magnet.toml", "rig.yaml", "yard.yaml", "stock.csv"),
        ("archive/**/*", "fleet.toml", "magnet.toml", "rig.yaml", "yard.yaml", "stock.csv"),
        run_words(
            "fleet", "plan", "FOLDER/archive", "--results", "FOLDER/made", "--store", "sqlite:///FOLDER/yard.db",
            "--config", "FOLDER/fleet.toml", "--magnet", "FOLDER/magnet.toml", "--rig", "FOLDER/rig.yaml",
        ), (), 0.6, warm=False,
    ),
    Target(
        "fleet status", ("fleet",), FLEET,
        run_words("fleet", "status", "--results", "FOLDER/fleet", "--store", "sqlite:///FOLDER/fleet/yard.db"),
        (), 0.5, warm=False,
    ),
    Target("fleet compare", ("fleet",), FLEET, compare_versions, ("made",), 0.5, warm=False),
    Target("fleet promote", ("fleet",), FLEET, promote_version, (), 0.5, warm=False),
    Target(
        "budget", ("euroc", "out", "certificate.json"), (*RESULT, "certificate.json"),
        run_words(
            "budget", "FOLDER/out", "--certificate", "FOLDER/certificate.json", "-o", "FOLDER/made.json"
        ),
        ("made.json",), 0.5, warm=False,
    ),
    Target(
        "accept --plan", ("euroc", "out"), RESULT,
        run_words("accept", "--plan", "FOLDER/out", "-o", "FOLDER/made.toml"), ("made.toml",), 0.5,
        warm=False,
    ),
    Target(
        "magnet offset", ("certificate.json", "magnet.toml"), ("certificate.json", "magnet.toml"),
        run_words(
            "calibrate", "magnet", "FOLDER/certificate.json", "--magnet", "FOLDER/magnet.toml", "-o",
            "FOLDER/made.toml",
        ),
        ("made.toml",), 0.5,
    ),
    Target("plan of acceptance", ("plan.toml",), ("plan.toml",), _plan),
    Target("watch", ("watch.json",), ("watch.json",), _watch),
    Target("users", ("users.json",), ("users.json",), _users, (), 0.5),
    Target(
        "commission", ("commission",), ("commission/*",),
        run_words("commission", "FOLDER/commission"), (), 0.5,
    ),
    Target("export", ("out",), RESULT, run_words("export", "FOLDER/out", "FOLDER/made.las"), ("made.las",)),
    Target("view", ("out",), RESULT, _view, (), 0.6, warm=False),
    Target(
        "measure", ("euroc",), ("euroc/mav0/**/*",),
        run_words(
            "measure", "FOLDER/euroc", "-o", "FOLDER/made", "--stereo.method", "sgbm", "--map.cell-m", "0.05"
        ),
        ("made",), 0.15, warm=False,
    ),
)  # fmt: skip
