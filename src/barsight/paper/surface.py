"""Show sub-pixel stereo on one view [paper Figures 1-3]."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Float32, Float64
from barsight.core.errors import Failed
from barsight.core.records.pairs import RectifiedPair
from barsight.paper.pictures import BLUE, RED, PaperPicture, heat_picture, line_picture
from barsight.report.map_images import hillshade
from barsight.stereo.search_range import find_disparity_range
from barsight.stereo.settings import StereoSettings, make_method

WINDOW_PX = 7


def match_three(pair: RectifiedPair) -> dict[str, Float32]:
    """Match by SGBM (the loop's D0), by the paper's loop and by our method: disparities (H, W), px."""
    candidates = find_disparity_range(pair)
    if isinstance(candidates, Failed):
        return {}
    names = {"D0 (SGBM)": "sgbm", "paper": "paper", "ours": "barsight"}
    return {
        label: make_method(StereoSettings(method=name))(pair, candidates).disparity_px  # type: ignore[arg-type]
        for label, name in names.items()
    }


def cost_curve(pair: RectifiedPair, disparity: Float32) -> PaperPicture:
    """Draw a textured pixel's costs around their minimum, and the parabola through three [paper Figure 1]."""
    gray = pair.left.astype(np.float32)
    strength = cv2.boxFilter(np.abs(cv2.Sobel(gray, cv2.CV_32F, 1, 0)), -1, (WINDOW_PX, WINDOW_PX))
    reach = WINDOW_PX + 4
    inside = np.zeros(gray.shape, np.bool_)
    inside[reach:-reach, reach + int(np.nanmax(disparity)) : -reach] = True
    usable = inside & np.isfinite(disparity)
    if not usable.any():
        usable = np.isfinite(disparity)
    row, column = divmod(int(np.argmax(np.where(usable, strength, -1))), gray.shape[1])
    candidates = round(float(disparity[row, column])) + np.arange(-4, 5)
    half = WINDOW_PX // 2
    patch = gray[row - half : row + half + 1, column - half : column + half + 1]
    costs = np.full(candidates.size, np.nan)
    for k, shift in enumerate(candidates):
        left = column - shift - half
        other = pair.right[row - half : row + half + 1, max(left, 0) : max(left, 0) + WINDOW_PX]
        if left >= 0 and other.shape == patch.shape:
            costs[k] = float(np.abs(patch - other).mean())
    best = int(np.clip(np.nanargmin(costs), 1, candidates.size - 2))
    below, least, above = costs[best - 1 : best + 2]
    bend = below + above - 2 * least
    offset = (below - above) / (2 * bend) if bend > 0 else 0.0
    fine = np.linspace(-1, 1, 60)
    parabola = least + fine * (above - below) / 2 + fine**2 * bend / 2
    found = candidates[best] + offset
    return line_picture(
        [(candidates.astype(np.float64), costs, RED), (candidates[best] + fine, parabola, BLUE)],
        ("px", "gray levels"),
        f"Costs of whole disparities (red) and the parabola (blue): the least is {candidates[best]} px, "
        f"Eq. 4 says {found:.2f} px.",
    )


def loop_pictures(disparities: dict[str, Float32]) -> tuple[PaperPicture, ...]:
    """Draw D0 and the loop's result [paper Figure 2], with their shares of nearly whole disparities."""
    return tuple(
        heat_picture(disparities[label], f"{label}: {whole_pct(disparities[label]):.0f} % lie within "
                     "0.1 px of a whole disparity (20 % would by chance)")
        for label in ("D0 (SGBM)", "paper")
    )  # fmt: skip


def whole_pct(disparity: Float32) -> float:
    """Compute the share of disparities within 0.1 px of a whole number, %."""
    known = disparity[np.isfinite(disparity)]
    return 100 * float((np.abs(known - np.round(known)) < 0.1).mean()) if known.size else float("nan")


def depth_maps(pair: RectifiedPair, disparities: dict[str, Float32]) -> dict[str, Float64]:
    """Compute depth (H, W), m, from whole disparities, the paper's and ours; NaN where unmatched."""
    shown = {"whole disparities": np.round(disparities["paper"])}
    shown |= {"paper, below the pixel": disparities["paper"], "ours": disparities["ours"]}
    camera = pair.camera
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            label: camera.focal_px * camera.baseline_m / (disparity.astype(np.float64) + camera.doffs_px)
            for label, disparity in shown.items()
        }


def depth_errors_mm(depths: dict[str, Float64], true_m: Float64 | None) -> dict[str, float]:
    """Compute each map's median depth error, mm, where all have a depth; NaN without true depth (H, W)."""
    if true_m is None:
        return dict.fromkeys(depths, float("nan"))
    off = {label: 1e3 * np.abs(depth - true_m) for label, depth in depths.items()}
    known = np.logical_and.reduce([np.isfinite(one) for one in off.values()])
    return {
        label: float(np.median(one[known])) if known.any() else float("nan") for label, one in off.items()
    }


def relief_pictures(
    pair: RectifiedPair, depths: dict[str, Float64], errors_mm: dict[str, float]
) -> tuple[PaperPicture, ...]:
    """Draw the view's relief from whole disparities, the paper's and ours [paper Figure 3], lit obliquely;
    captioned with the median depth error if it is known.
    """
    made = []
    for label, depth in depths.items():
        cell = float(np.nanmedian(depth)) / pair.camera.focal_px
        relief = hillshade((-depth).astype(np.float32), cell)
        relief[~np.isfinite(depth)] = np.nan
        error = errors_mm[label]
        note = f"; median depth error {error:.0f} mm" if np.isfinite(error) else ""
        made.append(heat_picture(relief, label + note, (0.2, 1.4)))
    return tuple(made)
