"""Render, measure and score drawn worlds; stored results are recomputed only if their inputs changed."""

from __future__ import annotations

import json
import shutil
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import barsight
from barsight.benchmarks.yard.world_scores import WorldScore, score_world
from barsight.core.compiling.sources import sources_digest
from barsight.core.errors import BarsightError, ConfigError, OutputError
from barsight.core.json_values import json_digest, json_value, write_json
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.worlds.recording import GENERATOR, draw_world, simulate_world

NOTE = "world.json"
LIST = "looked_at.toml"
DRAWS = ("simulation", "calibration/geometry")
"""Packages that determine a seed's recording."""
MEASURES_NOT = ("simulation", "benchmarks", "cli", "viewer", "evaluation")
"""Packages that don't affect the measurement of a recording."""
SCORES = ("benchmarks/yard", "evaluation")
"""Packages that determine the score of a measurement."""
Measure = Callable[[Path, Path], object]


@dataclass(frozen=True)
class WorldKeys:
    """Digests of everything on which the recording, measurement and score of every seed depend."""

    recording: str
    measured: str
    score: str

    @classmethod
    def of(cls, given: object, draws: Sequence[str] = DRAWS) -> WorldKeys:
        """Compute the digests from the settings and the package's sources.

        draws: the sources that decide a recording.
        """
        root = Path(barsight.__file__).parent
        measuring = [path.name for path in root.iterdir() if path.name not in (*MEASURES_NOT, "__pycache__")]
        drawn = json_digest([GENERATOR, json_value(given), sources_digest(root, draws)])
        measured = json_digest([drawn, sources_digest(root, measuring)])
        return cls(drawn, measured, json_digest([measured, sources_digest(root, SCORES)]))


def run_world(
    keep: Path, seed: int, given: SimulationSettings, keys: WorldKeys, measure: Measure, looked_at: str
) -> WorldScore:
    """Score one world in its own folder of `keep`, reusing what is still valid there.

    measure: measures a recording into a folder. looked_at: reason why the seed counts as looked at from now
    on; empty if it doesn't. A recording that Barsight refuses to measure gets a score too. Raises OutputError
    for a folder that doesn't belong to this benchmark.
    """
    folder = keep / f"seed_{seed}"
    note = read_note(folder, "worlds")
    note["looked_at"] = looked_at or note.get("looked_at", "") or looked_at_list().get(seed, "")
    note = keep_measured(
        folder, note, keys, lambda recording: simulate_world(recording, draw_world(seed, given)), measure
    )
    recording, out = folder / "recording", folder / "measured"
    done = None if note["refused"] else out
    if note.get("score") != keys.score:
        score = score_world(recording, done, note["looked_at"], note["refused"])
        note |= {"score": keys.score, "scores": json_value(score)}
    note["scores"]["looked_at"] = note["looked_at"]
    _write_note(folder, note)
    return _score(note["scores"])


def keep_measured(
    folder: Path, note: dict[str, Any], keys: WorldKeys, render: Callable[[Path], object], measure: Measure
) -> dict[str, Any]:
    """Render `recording` and measure it into `measured`, in a folder, reusing what these keys find there.

    note: from `read_note`. Returns the updated note, whose `refused` says why the product refused to measure.
    The note is written before anything is removed, so that a killed run leaves nothing under wrong keys.
    """
    recording, out = folder / "recording", folder / "measured"
    if note.get("recording") != keys.recording:
        note = {"bench": note["bench"], "looked_at": note.get("looked_at", ""), "recording": ""}
        _write_note(folder, note)
        _remove(recording, out)
    if not recording.is_dir():
        render(recording)
    note["recording"] = keys.recording
    if note.get("measured") != keys.measured or not (note["refused"] or out.is_dir()):
        note |= {"measured": "", "refused": "", "score": ""}
        _write_note(folder, note)
        _remove(out)
        try:
            measure(recording, out)
        except OutputError:
            raise
        except BarsightError as error:
            note["refused"] = str(error)
        note["measured"] = keys.measured
        _write_note(folder, note)
    return note


def looked_at_list() -> dict[int, str]:
    """Read the project's list of seeds that were looked at during tuning, each with the reason."""
    content = tomllib.loads((files("barsight.benchmarks.yard") / LIST).read_text(encoding="utf-8"))
    return {
        seed: entry["why"]
        for entry in content.get("seeds", [])
        if entry["generator"] == GENERATOR
        for seed in range(entry["first"], entry["last"] + 1)
    }


def read_note(folder: Path, bench: str) -> dict[str, Any]:
    """Read the note on what a folder keeps; create the folder if it doesn't exist.

    Raises OutputError for a folder that doesn't belong to this benchmark (`bench`).
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / NOTE
    if not path.is_file():
        if any(one.name not in ("recording", "measured") for one in folder.iterdir()):
            raise OutputError(f"{folder}: holds other things; name another folder with --keep")
        return {"bench": bench}
    try:
        note = {"bench": bench} | dict(json.loads(path.read_text(encoding="utf-8")))
    except ValueError as error:
        raise ConfigError(f"{path}: is damaged; remove it, and the world is done anew") from error
    if note["bench"] != bench:
        raise OutputError(f"{folder}: belongs to bench {note['bench']}; name another folder with --keep")
    return note


def _write_note(folder: Path, note: dict[str, Any]) -> None:
    write_json(folder / NOTE, note)


def _remove(*folders: Path) -> None:
    for folder in folders:
        if folder.is_dir():
            shutil.rmtree(folder)


def _score(content: dict[str, Any]) -> WorldScore:
    """Restore a score from its JSON: null stands for NaN, lists for tuples."""

    def numbers(values: list[float | None]) -> list[float]:
        return [float("nan") if v is None else v for v in values]

    return WorldScore(
        content["seed"], content["kind"], tuple(content["conditions"]), content["looked_at"],
        content["refused"], content["maps"], content["poses"], content["counts"],
        {name: numbers(values) for name, values in content["errors"].items()},
        {name: numbers(values) for name, values in content["sigmas"].items()},
    )  # fmt: skip
