"""Define the exception tree, and `Failed` for shortfalls that are expected.

Bugs raise ordinary exceptions. A user's mistake raises a `BarsightError`, whose text is one line that
names the file and the remedy; the command line prints it and exits with the error's `exit_code`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

MEASURE_AGAIN = "measure the recording again"
"""Remedy for a measured folder that is incomplete or damaged."""


class BarsightError(Exception):
    """Something that the user can put right; its text is one line."""

    exit_code = 1


class ConfigError(BarsightError):
    """A setting that is out of its range, misspelt or contradicts another; or a wrong command line."""

    exit_code = 2


class InputError(BarsightError):
    """An input that is missing, damaged or wrong.

    `path` names it, `problem` says what is wrong, `remedy` what to do.
    """

    exit_code = 3

    def __init__(self, path: Path | str, problem: str, remedy: str = "") -> None:
        self.path = Path(path)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{path}: {problem}" + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        """Return the parts from which another process can rebuild the error."""
        return type(self), (str(self.path), self.problem, self.remedy)


class CalibrationError(InputError):
    """An impossible calibration: a matrix that isn't a rotation, negative focal lengths, swapped cameras."""


class OutputError(BarsightError):
    """An output that could not be written completely; nothing of it is left."""

    exit_code = 4


class MeasurementError(BarsightError):
    """The inputs are readable but don't hold what is needed, or a check isn't passed: a verdict, an alarm."""

    exit_code = 5


class FrameMismatchError(ValueError):
    """Two poses were chained whose inner frames differ: a bug in the caller."""


@dataclass(frozen=True)
class Failed:
    """An expected shortfall: returned instead of a result, never raised.

    `code` is short and stable (for tables and counts), `reason` is a sentence with the numbers.
    """

    code: str
    reason: str

    def __str__(self) -> str:
        return self.reason
