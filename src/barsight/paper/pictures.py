"""Draw what the figures share: gray images with lines, coloured maps, and line plots."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, UInt8
from barsight.report.map_images import colours, data_uri, robust_range

Colour = tuple[int, int, int]
BLUE, GREEN, ORANGE, RED, BLACK = (96, 190, 255), (57, 211, 83), (242, 177, 52), (235, 60, 50), (40, 40, 40)
WIDTH_PX = 560


@dataclass(frozen=True)
class PaperPicture:
    """A picture of a figure: its data URI and caption. is_wide: it takes the full width of the page."""

    uri: str
    caption: str
    is_wide: bool = False


def picture_of(canvas: UInt8, caption: str) -> PaperPicture:
    """Encode a picture (H, W, 3) for the page; one wider than `WIDTH_PX` takes the page's full width."""
    opaque = np.full((*canvas.shape[:2], 1), 255, np.uint8)
    uri = data_uri(np.dstack([canvas, opaque]), lossless=False)
    return PaperPicture(uri, caption, canvas.shape[1] > WIDTH_PX)


def draw_lines(canvas: UInt8, old: Float64, new: Float64, kept: Bool, colour: Colour) -> None:
    """Draw lines from old to new positions (N, 2) where `kept`, with a small circle at the new one."""
    for (x0, y0), (x1, y1) in zip(old[kept], new[kept], strict=True):
        start, end = (round(x0), round(y0)), (round(x1), round(y1))
        cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, end, 2, colour, 1, cv2.LINE_AA)


def heat_picture(values: Float32, caption: str, span: tuple[float, float] | None = None) -> PaperPicture:
    """Draw values (H, W) in colour; unknown ones are dark."""
    low, high = span or robust_range(values, 2, 98)
    painted = colours(values, low, high, cv2.COLORMAP_VIRIDIS)
    painted[~np.isfinite(values)] = 25
    scale = WIDTH_PX / values.shape[1]
    return picture_of(cv2.resize(painted, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), caption)


def line_picture(
    lines: list[tuple[Float64, Float64, Colour]], axes: tuple[str, str], caption: str
) -> PaperPicture:
    """Plot lines (x, y, colour) on common axes, with the ends of the axes labelled."""
    width, height, edge = 2 * WIDTH_PX, 320, 46
    canvas = np.full((height, width, 3), 252, np.uint8)
    xs = np.concatenate([x[np.isfinite(y)] for x, y, _ in lines])
    ys = np.concatenate([y[np.isfinite(y)] for _, y, _ in lines])
    if xs.size == 0:
        return picture_of(canvas, caption)
    (left, right), (low, high) = (xs.min(), xs.max()), (ys.min(), ys.max())
    across = (width - 2 * edge) / max(right - left, 1e-9)
    up = (height - 2 * edge) / max(high - low, 1e-9)
    for x, y, colour in lines:
        known = np.isfinite(y)
        u, v = edge + (x - left) * across, height - edge - (np.where(known, y, 0) - low) * up
        at = np.round(16 * np.column_stack([u, v])).astype(np.int32)
        for k in np.flatnonzero(known[1:] & known[:-1]).tolist():
            cv2.line(canvas, at[k].tolist(), at[k + 1].tolist(), colour, 1, cv2.LINE_AA, 4)
    for text, place in (
        (f"{left:.2f}", (edge, height - 14)), (f"{right:.2f} {axes[0]}", (width - 3 * edge, height - 14)),
        (f"{low:.2f}", (2, height - edge)), (f"{high:.2f} {axes[1]}", (2, edge - 14)),
    ):  # fmt: skip
        cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, BLACK, 1, cv2.LINE_AA)
    return picture_of(canvas, caption)
