"""Read and write calibration YAML, with errors that name the file and the key."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, NodeEvent

from barsight.core.arrays import Float64
from barsight.core.errors import CalibrationError
from barsight.core.pose import Pose
from barsight.core.reading.bounded_reading import MAX_DEPTH, expect_modest, in_range, read_text

ROTATION_DECIMALS = 13
TRANSLATION_DECIMALS = 12
MAX_YAML_BYTES, MAX_YAML_NODES = 1 << 18, 20_000
"""Limits on a YAML file's size in bytes and number of values. A calibration with its covariance has some 20
kB and 2000 values; a file at the limit takes 4 s to parse.
"""
REMEDY = "take the original file"


@dataclass(frozen=True)
class Document:
    """A YAML mapping and the file it came from. Every getter raises `CalibrationError` naming the file and
    the key.
    """

    path: Path
    values: dict[str, Any]
    prefix: str = ""

    def error(self, key: str, problem: str, remedy: str) -> CalibrationError:
        """Make the error to raise about a key."""
        return CalibrationError(self.path, f"{self.prefix}{key}: {problem}", remedy)

    def get(self, key: str) -> Any:
        """Return the raw value of a required key."""
        if self.values.get(key) is None:
            raise self.error(key, "is missing", "add the key or take the calibration's original file")
        return self.values[key]

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number, or the default where one is given and the key is absent."""
        if default is not None and self.values.get(key) is None:
            return default
        return self.numbers_in(key, [self.get(key)])[0]

    def numbers(self, key: str, count: int | None = None) -> tuple[float, ...]:
        """Return a list of finite numbers, of length `count` where that is given."""
        value = self.get(key)
        if not isinstance(value, list):
            raise self.error(key, "is not a list of numbers", "write it as [a, b, ...]")
        numbers = self.numbers_in(key, value)
        if count is not None and len(numbers) != count:
            raise self.error(key, f"has {len(numbers)} numbers, expected {count}", "correct the list")
        return numbers

    def numbers_in(self, key: str, value: Sequence[Any]) -> tuple[float, ...]:
        """Convert the elements to finite floats. YAML 1.1 reads `1e-5` as text, so text is converted too."""
        try:
            numbers = tuple(float(v) for v in value if not isinstance(v, bool))
        except (TypeError, ValueError, OverflowError):
            numbers = ()
        if len(numbers) != len(value):
            raise self.error(key, "holds something that is not a number", "correct the entry")
        if not in_range(numbers).all():
            raise self.error(key, "is not finite or out of range", "write the calibrated number")
        return numbers

    def matrix(self, key: str) -> Float64:
        """Return a (4, 4) matrix from `{rows, cols, data}` (EuRoC), from four rows of four numbers (Kalibr)
        or from 16 numbers.
        """
        value = self.get(key)
        if isinstance(value, dict):
            value = value.get("data")
        if isinstance(value, list) and len(value) == 4 and all(isinstance(row, list) for row in value):
            value = [number for row in value for number in row]
        if not isinstance(value, list) or len(value) != 16:
            raise self.error(key, "is not a 4x4 matrix", "give 16 numbers, row by row")
        return np.array(self.numbers_in(key, value), dtype=np.float64).reshape(4, 4)

    def pose(self, key: str, target: str, source: str, *, inverted: bool = False) -> Pose:
        """Return `target_from_source` from a 4x4 matrix; `inverted` means that the file stores
        `source_from_target`.
        """
        matrix = self.matrix(key)
        try:
            return canonical_pose(target, source, matrix, inverted=inverted)
        except ValueError as error:
            raise self.error(key, str(error), "a calibration must hold a rotation; copy it again") from None

    def section(self, key: str) -> Document:
        """Return a mapping nested in this one."""
        value = self.get(key)
        if not isinstance(value, dict):
            raise self.error(key, "is not a mapping", "compare with Kalibr's file format")
        return Document(self.path, value, f"{self.prefix}{key}.")


def read_document(path: Path) -> Document:
    """Read a YAML mapping; the line `%YAML:1.0`, which OpenCV writes but YAML forbids, is ignored."""
    text = read_text(path, MAX_YAML_BYTES, REMEDY, CalibrationError)
    lines = ["" if line.startswith("%YAML") else line for line in text.splitlines()]
    try:
        values = _load("\n".join(lines))
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}: " if mark else ""
        problem = getattr(error, "problem", None) or "not readable"
        raise CalibrationError(path, f"{where}not YAML ({problem})", REMEDY) from None
    except RecursionError:
        raise CalibrationError(path, "not YAML (brackets nested too deeply)", REMEDY) from None
    except Exception as error:  # from an invalid date, a key that is a list, or invalid binary data
        raise CalibrationError(path, f"not YAML ({error})", REMEDY) from None
    if not isinstance(values, dict):
        raise CalibrationError(path, "is empty or no list of keys", "take the original file")
    return Document(path, {str(key): value for key, value in values.items()})


def _load(text: str) -> Any:
    """Load YAML with at most MAX_YAML_NODES values, counting the values that its aliases expand to.

    Raises ValueError, YAMLError and others.
    """
    events = YAML(typ="safe", pure=True).parse(text)
    sizes: dict[str, int] = {}
    open_parts: list[tuple[str | None, int]] = []
    nodes = 0
    for event in events:
        if isinstance(event, CollectionStartEvent):
            open_parts.append((event.anchor, nodes))
        if isinstance(event, CollectionEndEvent):
            anchor, before = open_parts.pop()
            if anchor is not None:
                sizes[anchor] = nodes - before
        elif isinstance(event, NodeEvent):
            nodes += sizes.get(event.anchor, 1) if isinstance(event, AliasEvent) else 1
        if nodes > MAX_YAML_NODES or len(open_parts) > MAX_DEPTH:
            raise ValueError(f"over {MAX_YAML_NODES} values or {MAX_DEPTH} brackets in brackets")
    values = YAML(typ="safe", pure=True).load(text)
    expect_modest(values)
    return values


def write_document(path: Path, values: dict[str, Any]) -> None:
    """Write a YAML mapping, with floats as Python's `repr` so that they read back bit for bit."""
    yaml = YAML(typ="safe", pure=True)
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.default_flow_style = None
    with path.open("w", encoding="utf-8") as stream:
        yaml.dump(values, stream)


def canonical_pose(target: str, source: str, matrix: Float64, *, inverted: bool = False) -> Pose:
    """Build a mounting whose numbers don't depend on which of its two directions a file stores.

    EuRoC stores `body_from_cam`, Kalibr `cam_from_body`; going through the inverse costs some 1e-16. The
    rotation is made orthonormal and rounded to 1e-13, which is fine enough for `Pose` to keep it unchanged
    (it projects above 1e-12), and the translation is rounded to 1e-12 m, so both files give the same bits.
    The inverse is that of the matrix, not the transpose: a rotation rounded to 1e-13 isn't orthonormal to
    1e-16. Raises ValueError where the matrix holds no rotation.
    """
    if inverted:
        Pose.from_matrix(source, target, matrix)
        matrix = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    pose = Pose.from_matrix(target, source, matrix)
    rotation = np.round(pose.rotation, ROTATION_DECIMALS) + 0.0
    translation = np.round(pose.translation, TRANSLATION_DECIMALS) + 0.0
    return Pose(target, source, rotation, translation)
