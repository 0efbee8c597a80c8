"""Find the direction in which a bar runs through each cell: a bar is straight, so heights along it are alike.

A single cell determines it only roughly, and not at all where the noise is as high as the bars. So each cell
first chooses one of 16 directions over a short distance, and blocks of cells then elect one of 80 close to
it.
"""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Bool, Float32, Int8, Int64, kernel

DIRECTIONS = 16
FINE_RATIO = 5
"""Number of elected directions per chosen one: 26 cells away, the nearest one is at most half a cell off
the bar.
"""
SAMPLE_CELLS = 2
CHOICE_CELLS, ELECTION_CELLS = 12, 16
"""Maximum distance to either side that is read to choose a cell's own direction, and to elect a block's."""
BLOCK_CELLS = 8
"""Side of a block of cells, which elects its direction together with the blocks around it."""
_NEAR, _MAX_SQUARES_RATIO = 8, np.float32(2.0)
"""Maximum difference, in elected directions, between a block's direction and a cell's own one, which noise
rotates; and the maximum ratio of the sums of squares along the two: what lies across the bars at an angle
keeps its own direction.
"""


def choose_directions(z: Float32, known: Bool, gate_m: float, reach: int) -> Int8:
    """Choose the one of 16 directions in which heights (H, W) are most alike, -1 where no height is known.

    Every other cell up to `reach` on either side is read, but none beyond CHOICE_CELLS. Differences from a
    cell's own height are limited to gate_m, which also stands for cells that are missing or outside.
    """
    reach = min(reach, CHOICE_CELLS)
    rows, columns = line_cells(DIRECTIONS, reach)
    padded = np.pad(z, reach, constant_values=np.nan)
    return _choose(padded, known, np.float32(gate_m), rows, columns, reach)


def elect_directions(z: Float32, direction: Int8, gate_m: float, reach: int) -> Int8:
    """Elect one of 80 directions (H, W) for the cells of a block whose own direction is close to it.

    In every other row and column, a cell votes for the best of the five directions around its own one (see
    `choose_directions`).
    """
    reach = min(reach, ELECTION_CELLS)
    rows, columns = line_cells(FINE_RATIO * DIRECTIONS, reach)
    padded = np.pad(z, reach, constant_values=np.nan)
    gate = np.float32(gate_m)
    elected = _elect(padded, direction, gate, rows, columns, reach)
    return _near_own(padded, direction, elected, gate, rows, columns, reach)


def line_cells(directions: int, reach: int) -> tuple[Int64, Int64]:
    """Compute offsets in rows and columns (directions, N) from a cell to every other cell along each
    direction, the cell itself in the middle.
    """
    turn = np.arange(directions)[:, None] * np.pi / directions
    onward = np.arange(SAMPLE_CELLS, reach + 1, SAMPLE_CELLS)
    along = np.r_[-onward[::-1], 0, onward]
    rows, columns = (np.rint(f(turn) * along).astype(np.int64) for f in (np.sin, np.cos))
    return rows, columns


@kernel()
def _choose(z: Float32, known: Bool, gate_m: np.float32, rows: Int64, columns: Int64, reach: int) -> Int8:
    """Choose the direction with the smallest sum of squares, the first one in a tie.

    z: (H + 2 reach, W + 2 reach). The squares of a whole row of cells are summed at once, direction by
    direction, so that the compiler can use vector instructions.
    """
    height, width = known.shape
    chosen = np.full((height, width), -1, np.int8)
    least, squares, best = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.int32)
    for i in range(height):
        there = np.flatnonzero(known[i])
        if there.size == 0:
            continue
        first, size = reach + there[0], there[-1] + 1 - there[0]
        own = z[i + reach, first : first + size]
        least[:size] = np.inf
        for d in range(rows.shape[0]):
            squares[:size] = 0
            for k in range(rows.shape[1]):
                b = first + columns[d, k]
                if rows[d, k] == 0 and columns[d, k] == 0:
                    continue
                _add_squares(squares[:size], z[i + reach + rows[d, k], b : b + size], own, gate_m)
            for j in range(size):
                best[j] = d if squares[j] < least[j] else best[j]
                least[j] = min(squares[j], least[j])
        for column in there:
            chosen[i, column] = best[column - there[0]]
    return chosen


@kernel()
def _add_squares(squares: Float32, beside: Float32, own: Float32, gate_m: np.float32) -> None:
    """Add the squared differences between two rows of heights (W,), each limited to the squared gate,
    which is also added where a height is missing.
    """
    for j in range(squares.size):
        gap = abs(beside[j] - own[j])
        squares[j] += gap * gap if gap <= gate_m else gate_m * gate_m


@kernel()
def _elect(z: Float32, direction: Int8, gate_m: np.float32, rows: Int64, columns: Int64, reach: int) -> Int8:
    """Elect the direction (blocks, blocks) with the most votes of a block and its eight neighbours, the first
    one in a tie; -1 where nobody votes.

    z: (H + 2 reach, W + 2 reach). direction: (H, W).
    """
    height, width = direction.shape
    votes = np.zeros(
        ((height - 1) // BLOCK_CELLS + 1, (width - 1) // BLOCK_CELLS + 1, rows.shape[0]), np.int32
    )
    for i in range(0, height, 2):
        for j in range(0, width, 2):
            if direction[i, j] < 0:
                continue
            best, least = 0, np.float32(np.inf)
            for turn in (0, -1, 1, -2, 2):
                way = (direction[i, j] * FINE_RATIO + turn) % rows.shape[0]
                squares = _squares(z, i + reach, j + reach, rows[way], columns[way], gate_m)
                if squares < least:
                    best, least = way, squares
            votes[i // BLOCK_CELLS, j // BLOCK_CELLS, best] += 1
    elected = np.full(votes.shape[:2], -1, np.int8)
    for i in range(votes.shape[0]):
        for j in range(votes.shape[1]):
            around = votes[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
            most = 0
            for way in range(rows.shape[0]):
                count = around[:, :, way].sum()
                if count > most:
                    most, elected[i, j] = count, way
    return elected


@kernel()
def _near_own(
    z: Float32, direction: Int8, elected: Int8, gate_m: np.float32, rows: Int64, columns: Int64, reach: int
) -> Int8:
    """Assign the block's direction where it is close to a cell's own and nearly as good there, else the
    cell's own, both in the finer steps (H, W); -1 stays.

    z: (H + 2 reach, W + 2 reach). direction: (H, W); elected: (blocks, blocks).
    """
    out = np.full(direction.shape, -1, np.int8)
    for i in range(direction.shape[0]):
        for j in range(direction.shape[1]):
            if direction[i, j] < 0:
                continue
            own, block = direction[i, j] * FINE_RATIO, elected[i // BLOCK_CELLS, j // BLOCK_CELLS]
            apart = abs(block - own)
            apart = min(apart, FINE_RATIO * DIRECTIONS - apart)
            is_near = block >= 0 and apart <= _NEAR
            if is_near and apart > FINE_RATIO // 2:
                ours = _squares(z, i + reach, j + reach, rows[own], columns[own], gate_m)
                theirs = _squares(z, i + reach, j + reach, rows[block], columns[block], gate_m)
                is_near = theirs <= _MAX_SQUARES_RATIO * ours
            out[i, j] = block if is_near else own
    return out


@kernel()
def _squares(z: Float32, i: int, j: int, rows: Int64, columns: Int64, gate_m: np.float32) -> np.float32:
    """Sum the squared differences from cell (i, j) along one direction, each limited to the squared gate.

    z: (H, W). rows, columns: (N,) offsets from the cell.
    """
    squares = np.float32(0)
    for k in range(rows.size):
        gap = abs(z[i + rows[k], j + columns[k]] - z[i, j])
        squares += gap * gap if gap <= gate_m else gate_m * gate_m
    return squares
