"""Draw round bars that are too thin to show in the heights: the picture's stripes give the position of
each bar, the heights give the level and slope of a row of bars, and the bars are round.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float32, Int8, kernel
from barsight.mapping.surface.bar_directions import DIRECTIONS
from barsight.mapping.surface.picture_stripes import NODE_CELLS, STEP_CELLS, Stripes

REACH_CELLS = 15
"""Distance, in cells, up to which a cell's bars depend on its surroundings: twice the widest pitch, or the
corner of a stripe window.
"""
_MAX_PITCH_CELLS, _MAX_PITCH_PX = 7.0, 10.0
"""Maximum distance between bars whose profile is drawn, in cells and in pixels."""
_BLUR_PX = 1.5
"""Blur of the heights across the bar by matching's support, 1 sigma."""
_PLACE_RATIO, _LINE_RATIO, _UNSEEN_RATIO, _SHOWN_MARGIN = 0.05, 0.25, 0.15, 0.6
_GLOSS_RATIO = 0.2 * (np.pi / 8 - 0.25)
"""Sigma of a row's mean level due to gloss, as a share of the diameter: a fifth of the distance to the
bars' highlights, which lie a quarter of the diameter below the crests, while the mean lies (1 / 2 - pi /
8) of it below them.
"""
_PHASES, _SLOPE_STEP, _SLOPES = 64, 0.06, 31
_ROUND = np.float32(np.sqrt(1 / 6 - np.pi**2 / 64))
"""RMS of a row of half circles about its mean, as a share of the diameter: 0.112."""


class _Profiles(NamedTuple):
    """Profiles of a row of touching bars minus its line, by slope and phase (slopes, phases), in pitches:
    expected height and its standard deviation, for a crest position that is uncertain by `_PLACE_RATIO` of
    the pitch.
    """

    expected: Float32
    spread: Float32


def draw_bars(
    z: Float32, direction: Int8, stripes: Stripes, pixel_cells: Float32, cell_m: float, draws: bool = True
) -> tuple[Float32, Float32, Float32]:
    """Draw bars over the heights z (H, W) if `draws` is set. Returns the bars' heights and their sigma, NaN
    where none is drawn, and the sigma of the relief hidden from the heights z where stripes are seen, else 0.

    direction: (H, W), of `smooth_along_bars`. pixel_cells: (H, W) width of a pixel. A row of bars is a line
    through the heights a pitch to either side (or one and two pitches to one side); the bars touch and are
    round: their diameter is the pitch over the line's cosine. They are drawn where the middle height is off
    the line by at most 25 % of the pitch, the pitch is at most seven cells and ten pixels, and the share of
    the profile that the heights show falls short of the expected share by less than 0.6. A blur of 1.5 pixels
    (sigma) determines the expected share; the mean height over a pitch, corrected for it, is the row's level.
    """
    drawn = np.full(z.shape, np.nan, np.float32)
    sigma, hidden = drawn.copy(), np.zeros(z.shape, np.float32)
    _draw(z, direction, stripes, pixel_cells, cell_m, draws, _profiles(), drawn, sigma, hidden)
    return drawn, sigma, hidden


@lru_cache(maxsize=1)
def _profiles() -> _Profiles:
    """Compute the profiles of rows of touching bars that rise by -0.9 to 0.9 per pitch; phase 0 is the
    middle between a bar's two borders with its neighbours, as seen from above.
    """
    fine = 2048
    x = (np.arange(4 * fine) + 0.5) / fine - 2
    phase = (np.arange(fine) + 0.5) / fine - 0.5
    blur = np.exp(-2 * (np.pi * np.fft.fftfreq(fine, 1 / fine) * _PLACE_RATIO) ** 2)
    expected, spread = [], []
    for slope in (np.arange(_SLOPES) - _SLOPES // 2) * _SLOPE_STEP:
        off = x - np.arange(-4, 5)[:, None]
        square = (1 + slope * slope) / 4 - off * off
        bars = np.where(square > 0, np.sqrt(np.maximum(square, 0)), -np.inf) + slope * (x - off)
        own = x[bars.argmax(axis=0) == 4]
        profile = np.interp(phase + (own[0] + own[-1]) / 2, x, bars.max(axis=0) - slope * x)
        profile -= profile.mean()
        mean, square_mean = (
            np.fft.ifft(np.fft.fft(np.fft.ifftshift(a)) * blur).real for a in (profile, profile**2)
        )
        expected.append(mean.reshape(_PHASES, -1).mean(axis=1))
        spread.append(np.sqrt(np.maximum(square_mean - mean**2, 0)).reshape(_PHASES, -1).mean(axis=1))
    return _Profiles(np.array(expected, np.float32), np.array(spread, np.float32))


@kernel()
def _draw(
    z: Float32, direction: Int8, stripes: Stripes, pixel_cells: Float32, cell_m: float, draws: bool,
    profiles: _Profiles, drawn: Float32, sigma: Float32, hidden: Float32,
) -> None:  # fmt: skip
    """Draw bars, see `draw_bars`. z, pixel_cells: (H, W), NaN where there is none; direction: (H, W), -1
    where there is none. Fills drawn, sigma and hidden (H, W).
    """
    height, width = z.shape
    step_m = STEP_CELLS * cell_m
    for i in range(height):
        for j in range(width):
            if direction[i, j] < 0:
                continue
            row, column = (i + NODE_CELLS // 2) // NODE_CELLS, (j + NODE_CELLS // 2) // NODE_CELLS
            if row >= stripes.pitch.shape[0] or column >= stripes.pitch.shape[1]:
                continue
            pitch = float(stripes.pitch[row, column])
            if pitch == 0:
                continue
            turn = direction[row * NODE_CELLS, column * NODE_CELLS] * np.pi / DIRECTIONS
            ways = np.cos(turn), -np.sin(turn), step_m
            shown = np.exp(-2 * (np.pi * _BLUR_PX * pixel_cells[i, j] / pitch) ** 2)
            hidden[i, j] = _ROUND * (1 - shown) * pitch * cell_m
            if pitch > _MAX_PITCH_CELLS:
                continue
            rise_m, off_m = _line(z, i, j, ways, pitch, _UNSEEN_RATIO * pitch * cell_m)
            if off_m > 0:
                hidden[i, j] = np.hypot(hidden[i, j], (1 - shown) * off_m / 2)
            if (
                not draws
                or pitch > _MAX_PITCH_PX * pixel_cells[i, j]
                or not off_m <= _LINE_RATIO * pitch * cell_m
            ):
                continue
            slope = round(rise_m / (pitch * cell_m) / _SLOPE_STEP) + _SLOPES // 2
            slope = min(max(slope, 0), _SLOPES - 1)
            crest = (i - row * NODE_CELLS) * ways[0] + (j - column * NODE_CELLS) * ways[1]
            crest -= stripes.crest[row, column]
            profile = profiles.expected[slope]
            level_m, found = _level(z, i, j, ways, pitch, rise_m, crest, profile, shown, cell_m)
            if not found > shown - _SHOWN_MARGIN:
                continue
            phase = int(np.floor((crest / pitch - np.floor(crest / pitch)) * _PHASES)) % _PHASES
            drawn[i, j] = level_m + profile[phase] * pitch * cell_m
            spread_m = profiles.spread[slope, phase] * pitch * cell_m
            gloss_m = _GLOSS_RATIO * pitch * cell_m
            sigma[i, j] = np.sqrt(spread_m * spread_m + off_m * off_m / 4 + gloss_m * gloss_m)


@kernel()
def _line(
    z: Float32, i: int, j: int, ways: tuple[float, float, float], pitch: float, unseen_m: float
) -> tuple[float, float]:
    """Compute the rise (m) per pitch of the row of bars at cell (i, j), and how far the middle of three
    heights a pitch apart is off a line; unseen_m where only two are on one surface, NaN where only one is.

    z: (H, W). ways: see `_level`.
    """
    here = float(z[i, j])
    after, before = _height_at(z, i, j, ways, pitch), _height_at(z, i, j, ways, -pitch)
    if np.isnan(after) and np.isnan(before):
        return np.nan, np.nan
    if np.isnan(before):
        further = _height_at(z, i, j, ways, 2 * pitch)
        return after - here, unseen_m if np.isnan(further) else abs(here + further - 2 * after) / 2
    if np.isnan(after):
        further = _height_at(z, i, j, ways, -2 * pitch)
        return here - before, unseen_m if np.isnan(further) else abs(here + further - 2 * before) / 2
    return (after - before) / 2, abs(after + before - 2 * here) / 2


@kernel()
def _height_at(z: Float32, i: int, j: int, ways: tuple[float, float, float], way: float) -> float:
    """Interpolate the height (m) `way` cells across the bar from cell (i, j); NaN if there is a step in
    between.

    z: (H, W). ways: see `_level`. way: negative for the other side.
    """
    down, right, step_m = ways
    side, cells = (1 if way > 0 else -1), int(np.ceil(abs(way)))
    last = before = float(z[i, j])
    for n in range(1, cells + 1):
        a, b = i + round(side * n * down), j + round(side * n * right)
        if not (0 <= a < z.shape[0] and 0 <= b < z.shape[1]) or not abs(z[a, b] - last) <= step_m:
            return np.nan
        before, last = last, float(z[a, b])
    return last + (cells - abs(way)) * (before - last)


@kernel()
def _level(
    z: Float32, i: int, j: int, ways: tuple[float, float, float], pitch: float, rise_m: float, crest: float,
    profile: Float32, shown: float, cell_m: float,
) -> tuple[float, float]:  # fmt: skip
    """Average the heights over a pitch around cell (i, j), minus the row's line and the expected share of the
    profile, m; and fit the share that the heights show, over a pitch to either side.

    z: (H, W). ways: a step across the bar in rows and in columns, and the height difference at which a
    surface ends. crest: distance in cells from the nearest crest to (i, j). profile: (phases,) for a pitch of
    1; shown: the expected share.
    """
    down, right, step_m = ways
    total, weights = 0.0, 0.0
    n, sz, sm, szm, smm = 0.0, 0.0, 0.0, 0.0, 0.0
    for side in (-1, 1):
        last = z[i, j]
        for k in range((1 - side) // 2, int(np.ceil(pitch)) + 1):
            a, b = i + round(side * k * down), j + round(side * k * right)
            if not (0 <= a < z.shape[0] and 0 <= b < z.shape[1]) or not abs(z[a, b] - last) <= step_m:
                break
            last = z[a, b]
            turns = (crest + side * k) / pitch
            phase = int(np.floor((turns - np.floor(turns)) * _PHASES)) % _PHASES
            high_m = last - side * k * rise_m / pitch
            bar_m = profile[phase] * pitch * cell_m
            weight = min(max(pitch / 2 + 0.5 - k, 0.0), 1.0)
            total += weight * (high_m - shown * bar_m)
            weights += weight
            n, sz, sm = n + 1, sz + high_m - z[i, j], sm + bar_m
            szm, smm = szm + (high_m - z[i, j]) * bar_m, smm + bar_m * bar_m
    return total / weights, (szm - sz * sm / n) / (smm - sm * sm / n)
