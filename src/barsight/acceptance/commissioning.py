"""Guide a rig from unpacking to its certificate: the steps done and the next one, all in one folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from barsight.acceptance.certificate import CommissioningStep
from barsight.core.errors import ConfigError, InputError
from barsight.core.files import atomic_path, translated_os_errors
from barsight.core.json_values import json_digest, json_value
from barsight.core.reading.json_schema import expect_schema, list_schema, record_schema
from barsight.core.reading.sealed_json import read_sealed, write_sealed
from barsight.core.settings.file import read_settings
from barsight.core.settings.values import POSITIVE, expect_ranges, expect_values
from barsight.result_folder import file_digest

RECORD, SETTINGS = "commissioning.json", "commission.toml"
SCHEMA_VERSION = 1
REMEDY = "take the folder that barsight commission made, or begin a new one"
_TEXT = {"type": "string"}
_STEP = record_schema(name=_TEXT, result=_TEXT, given=_TEXT, made=_TEXT, done_at=_TEXT)
_SCHEMA = record_schema(
    schema_version={"const": SCHEMA_VERSION}, content_sha256=_TEXT, steps=list_schema(_STEP)
)
HELP = "docs/how-to/commission.md explains the steps"
FIRST_SETTINGS = """\
# What barsight commission needs to know of this crane.
yard = ""                               # which yard or crane it is
signer = ""                             # who answers for the certificate
board = "checkerboard:9x6:0.025"        # as barsight calibrate stereo takes it; measure the board
range_m = 7.0                           # working distance, at which the calibration is judged
use_tags = false                        # true: AprilTags in survey/ place the yard; tags.csv lists them
# girder_y_m = [-10.0, 10.0]            # with use_tags: the trolley's readings at the girder's ends
# rails_x_m = [0.0, 60.0]               # with girder_y_m: the bridge's at the rails' ends
use_targets = false                     # true: targets.csv says where the crane's readings lie in the yard
# magnet = "magnet.toml"                # whose [offset] is taken off what the crane gets
"""


@dataclass(frozen=True)
class CommissionSettings:
    """Settings of a commissioning. girder_y_m, rails_x_m: as for `barsight calibrate yard`. magnet, key:
    files next to the settings file; key: private key for the signature.
    """

    yard: str = ""
    signer: str = ""
    board: str = "checkerboard:9x6:0.025"
    range_m: float = 7.0
    use_targets: bool = False
    use_tags: bool = False
    girder_y_m: tuple[float, float] | None = None
    rails_x_m: tuple[float, float] | None = None
    magnet: str | None = None
    key: str | None = None

    def __post_init__(self) -> None:
        expect_values(self)
        expect_ranges(self, "commission.", range_m=POSITIVE)
        if self.use_tags and self.use_targets:
            raise ConfigError("commission: use_tags and use_targets both place the yard; take one of them")
        if self.girder_y_m is not None and not self.use_tags:
            raise ConfigError("commission: girder_y_m needs use_tags")


@dataclass(frozen=True)
class GuidedStep:
    """A step of the commissioning.

    takes: input files or folders. makes: its output. bring: what the user must supply where the input is
    missing. do: performs the step and returns its result in words. told: settings that the step depends on.
    """

    name: str
    takes: tuple[str, ...]
    makes: tuple[str, ...]
    bring: str
    do: Callable[[], str]
    told: tuple[object, ...] = ()


@dataclass(frozen=True)
class DoneStep:
    """A completed step. given: digest of its inputs and settings. made: digest of its output."""

    name: str
    result: str
    given: str
    made: str
    done_at: str

    def told(self) -> CommissioningStep:
        """Return the step as a certificate lists it."""
        return CommissioningStep(self.name, self.result, self.made, self.done_at)


def begin(folder: Path) -> CommissionSettings:
    """Read the folder's settings, which are created in a new folder. Raises InputError and ConfigError."""
    path = folder / SETTINGS
    if not path.exists():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(folder, f"holds no {SETTINGS}", REMEDY)
        with translated_os_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as made:
            made.write_text(FIRST_SETTINGS, encoding="utf-8")
    return read_settings(path, CommissionSettings, HELP, "folder")


def walk(folder: Path, steps: Sequence[GuidedStep]) -> tuple[tuple[DoneStep, ...], GuidedStep | None]:
    """Run every step that can be run, in order. Returns the completed steps and the next one that lacks its
    input.

    A step is run again if its inputs, settings or output have changed. Raises what a step raises; the steps
    before it stay completed.
    """
    known = {one.name: one for one in read_done(folder)}
    done: list[DoneStep] = []
    for step in steps:
        if not all((folder / name).exists() for name in step.takes):
            _write_done(folder, done)
            return tuple(done), step
        given = _digest(folder, step.takes, step.told)
        before = known.get(step.name)
        if before is None or (before.given, before.made) != (given, _digest(folder, step.makes)):
            _write_done(folder, done)
            result = step.do()
            now = datetime.now(UTC).isoformat(timespec="seconds")
            before = DoneStep(step.name, result, given, _digest(folder, step.makes), now)
        done.append(before)
        _write_done(folder, done)
    return tuple(done), None


def read_done(folder: Path) -> tuple[DoneStep, ...]:
    """Read the completed steps. Raises InputError where the record was altered."""
    path = folder / RECORD
    if not path.exists():
        return ()
    content = read_sealed(path, SCHEMA_VERSION, REMEDY)
    expect_schema(content, _SCHEMA, path, REMEDY)
    return tuple(DoneStep(**one) for one in content["steps"])


def _write_done(folder: Path, done: Sequence[DoneStep]) -> None:
    content = {"schema_version": SCHEMA_VERSION, "steps": [asdict(one) for one in done]}
    write_sealed(json_value(content), folder / RECORD)


def _digest(folder: Path, names: Sequence[str], settings: Sequence[object] = ()) -> str:
    """Compute a digest of settings, files and folders. Of pictures, point clouds and files of 16 MiB or more,
    only the size is used.
    """
    found: list[object] = [json_value(one) for one in settings]
    for name in names:
        path = folder / name
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if not file.is_file():
                continue
            small = file.stat().st_size < 1 << 24 and file.suffix not in (".png", ".jpg", ".tif", ".ply")
            content = file_digest(file) if small else str(file.stat().st_size)
            found.append([file.relative_to(folder).as_posix(), content])
    return json_digest(found)
