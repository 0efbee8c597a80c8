"""Parse the text form of a board, such as `checkerboard:9x6:0.025`, and compute its points."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.errors import ConfigError

MAX_PER_SIDE = 100
LARGEST_M = 2.0
BOARD_FORMS = (
    "checkerboard:9x6:0.025 (inner corners, square in m), charuco:11x8:0.03:0.022[:DICT_5X5_250] (squares, "
    "square and marker in m) or aprilgrid:6x6:0.088:0.3 (tags, tag in m, gap as a share of the tag)"
)


class BoardKind(StrEnum):
    """Kinds of calibration pattern."""

    CHECKERBOARD = "checkerboard"
    CHARUCO = "charuco"
    APRILGRID = "aprilgrid"


@dataclass(frozen=True)
class Board:
    """A flat calibration board.

    columns, rows: number of inner corners of a checkerboard, of squares of a ChArUco board, or of tags of an
    AprilGrid. size_m: side of a square, or side of a tag measured over its black border. marker_m: side of a
    ChArUco marker, 0 for other boards. spacing: gap between the tags of an AprilGrid as a fraction of the tag
    size [Kalibr], 0 for other boards. dictionary: marker dictionary of a ChArUco board.
    Raises ConfigError where the numbers do not describe a board.
    """

    kind: BoardKind
    columns: int
    rows: int
    size_m: float
    marker_m: float = 0.0
    spacing: float = 0.0
    dictionary: str = "DICT_5X5_250"

    def __post_init__(self) -> None:
        least = {BoardKind.CHECKERBOARD: 3, BoardKind.CHARUCO: 3, BoardKind.APRILGRID: 1}[self.kind]
        if not (least <= self.columns <= MAX_PER_SIDE and least <= self.rows <= MAX_PER_SIDE):
            raise ConfigError(f"a {self.kind} of {self.columns}x{self.rows} is impossible; {BOARD_FORMS}")
        if not 0 < self.size_m <= LARGEST_M:
            raise ConfigError(f"a size of {self.size_m} m is impossible; sizes are in metres: {BOARD_FORMS}")
        if self.kind is BoardKind.CHARUCO and not 0 < self.marker_m < self.size_m:
            raise ConfigError(f"a marker of {self.marker_m} m doesn't fit a square of {self.size_m} m")
        if self.kind is BoardKind.APRILGRID and not 0 < self.spacing < 10:
            raise ConfigError(f"a spacing of {self.spacing} is impossible; Kalibr's boards have 0.3")

    @property
    def points_m(self) -> Float64:
        """Return the board's points (N, 3) in metres at z = 0, indexed by the ids that detections carry.

        Checkerboard and ChArUco: inner corners row by row. AprilGrid: four corners per tag, counter-clockwise
        from the lower left, with the tags row by row from the bottom [Kalibr].
        """
        if self.kind is BoardKind.APRILGRID:
            step = self.size_m * (1 + self.spacing)
            y, x = np.mgrid[: self.rows, : self.columns].reshape(2, -1) * step
            corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * self.size_m
            plane = (np.column_stack([x, y])[:, None] + corner).reshape(-1, 2)
        else:
            less = 1 if self.kind is BoardKind.CHARUCO else 0
            y, x = np.mgrid[: self.rows - less, : self.columns - less].reshape(2, -1) * self.size_m
            plane = np.column_stack([x, y])
        return np.column_stack([plane, np.zeros(len(plane))]).astype(np.float64)

    def __str__(self) -> str:
        text = f"{self.kind}:{self.columns}x{self.rows}:{self.size_m:g}"
        if self.kind is BoardKind.CHARUCO:
            return f"{text}:{self.marker_m:g}:{self.dictionary}"
        return f"{text}:{self.spacing:g}" if self.kind is BoardKind.APRILGRID else text


def parse_board(text: str) -> Board:
    """Parse a text such as `checkerboard:9x6:0.025`. Raises ConfigError that lists the accepted forms."""
    kind, *rest = text.strip().split(":")
    counts = {"checkerboard": (2,), "charuco": (3, 4), "aprilgrid": (3,)}
    try:
        if len(rest) not in counts[kind]:
            raise ValueError
        columns, rows = (int(part) for part in rest[0].lower().split("x"))
        sizes = [float(part) for part in rest[1:3]]
    except (KeyError, ValueError):
        raise ConfigError(f"board {text!r} is not a board; give {BOARD_FORMS}") from None
    if kind == "checkerboard":
        return Board(BoardKind.CHECKERBOARD, columns, rows, sizes[0])
    if kind == "aprilgrid":
        return Board(BoardKind.APRILGRID, columns, rows, sizes[0], spacing=sizes[1])
    name = rest[3].upper() if len(rest) == 4 else "DICT_5X5_250"
    return Board(BoardKind.CHARUCO, columns, rows, sizes[0], marker_m=sizes[1], dictionary=name)
