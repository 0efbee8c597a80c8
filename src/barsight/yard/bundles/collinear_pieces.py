"""Join two collinear pieces that were read as separate bundles but belong to one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.yard.bundles.doubts import list_hidden_gaps
from barsight.yard.bundles.fitting.ends import middle_and_length_sigma
from barsight.yard.types import ENDS, Bundle, BundleSigma, Doubt, DoubtKind

_SKEW, _ASIDE_RATIO, _LEVEL_M = 0.05, 0.3, 0.04
"""Maximum differences between two pieces of one bundle: sine of the skew, lateral distance between the axes
in widths of the narrower one, and height between the tops (m).
"""
_GAP_M = 0.6
"""Maximum gap between two pieces, and maximum length by which they overlap (m)."""
_ALIKE_LOG = 0.7
"""Maximum logarithm of the ratio between the widths of two pieces of one bundle."""


def join_pieces(bundles: list[Bundle]) -> list[Bundle]:
    """Join pieces that continue each other where the ends that face each other are open and no gap shows.

    The longer piece supplies the values; its sigma is widened by how much the other one differs.
    """
    left = sorted(bundles, key=lambda bundle: -bundle.length_m)
    out: list[Bundle] = []
    for piece in left:
        for k, whole in enumerate(out):
            joined = _joined(whole, piece)
            if joined is not None:
                out[k] = joined
                break
        else:
            out.append(piece)
    return out


def _joined(whole: Bundle, piece: Bundle) -> Bundle | None:
    """Join a piece to a longer bundle; None where it isn't certain that they are one."""
    along = np.array([-np.sin(whole.yaw_rad), np.cos(whole.yaw_rad)])
    if abs(np.sin(piece.yaw_rad - whole.yaw_rad)) > _SKEW:
        return None
    order = [0, 1] if np.cos(piece.yaw_rad - whole.yaw_rad) > 0 else [1, 0]
    away = (piece.ends_m[order] - whole.centre_m) @ np.column_stack(
        [np.append(along, 0), (along[1], -along[0], 0)]
    )
    side = int(away[:, 0].mean() > 0)
    own = float((whole.ends_m[side] - whole.centre_m)[:2] @ along)
    gap = (away[1 - side, 0] - own) * (1 if side else -1)
    aside, width = float(np.abs(away[:, 1]).max()), piece.width_m / whole.width_m
    if not (
        whole.ends_open[side]
        and piece.ends_open[order[1 - side]]
        and abs(gap) < _GAP_M
        and aside < _ASIDE_RATIO * min(whole.width_m, piece.width_m)
        and abs(whole.top_z_m - piece.top_z_m) < _LEVEL_M
        and abs(np.log(width)) < _ALIKE_LOG
    ):
        return None
    if _has(whole, DoubtKind.GAP, side) or _has(piece, DoubtKind.GAP, order[1 - side]):
        return None
    end = whole.ends_m[side] + (away[side, 0] - own) * whole.direction / np.cos(whole.pitch_rad)
    ends = np.array([whole.ends_m[0], end] if side else [end, whole.ends_m[1]])
    far = order[side]
    is_open, sigmas = list(whole.ends_open), list(whole.ends_sigma_m)
    is_open[side], sigmas[side] = piece.ends_open[far], piece.ends_sigma_m[far]
    # Straps on either piece hold both.
    kept, others = (
        tuple(
            doubt for doubt in one.reasons if doubt.kind is not DoubtKind.NO_STRAPS or doubt in other.reasons
        )
        for one, other in ((whole, piece), (piece, whole))
    )
    kept = tuple(doubt for doubt in kept if doubt.end != side)
    added = (doubt for doubt in others if doubt.end in (None, far) and doubt not in kept)
    covered = any(_has(one, DoubtKind.COVERED_END, end) for one, end in ((whole, side), (piece, 1 - far)))
    between = _list_between(float(gap), covered=covered)
    reasons = (*kept, *(_at_end(doubt, side) for doubt in added), *between)
    return replace(
        whole, centre_m=ends.mean(axis=0), ends_m=ends, ends_open=(is_open[0], is_open[1]),
        ends_sigma_m=(sigmas[0], sigmas[1]), length_m=float(np.linalg.norm(ends[1] - ends[0])),
        sigma=_joined_sigma(whole, piece, aside, (sigmas[0], sigmas[1])),
        bars=whole.bars if whole.bars == piece.bars else None,
        confidence=min(whole.confidence, piece.confidence), reasons=reasons,
        cover_doubts=tuple(dict.fromkeys(whole.cover_doubts + piece.cover_doubts)),
    )  # fmt: skip


def _joined_sigma(whole: Bundle, piece: Bundle, aside_m: float, ends_m: tuple[float, float]) -> BundleSigma:
    """Widen the sigma of a bundle by what a piece joined to it differs. aside_m: greatest distance of the
    piece's ends from the axis. ends_m: sigmas of the ends of both together.
    """
    middle, length = middle_and_length_sigma(ends_m)
    known = np.isfinite(piece.section_m2)
    section = piece.section_m2 if known else whole.section_m2 * (piece.width_m / whole.width_m) ** 2
    return replace(
        whole.sigma,
        lateral_m=float(np.hypot(whole.sigma.lateral_m, aside_m)),
        width_m=float(np.hypot(whole.sigma.width_m, piece.width_m - whole.width_m)),
        top_z_m=float(np.hypot(whole.sigma.top_z_m, piece.top_z_m - whole.top_z_m)),
        bar_diameter_m=float(
            np.hypot(whole.sigma.bar_diameter_m, piece.bar_diameter_m - whole.bar_diameter_m)
        ),
        along_m=middle,
        length_m=length,
        section_m2=float(np.hypot(whole.sigma.section_m2, section - whole.section_m2)),
    )


def _has(bundle: Bundle, kind: DoubtKind, end: int) -> bool:
    return any(doubt.kind is kind and doubt.end == end for doubt in bundle.reasons)


def _list_between(gap_m: float, *, covered: bool) -> list[Doubt]:
    """List the doubts about what lies between two pieces: what covers it, or a gap that isn't seen."""
    if covered:
        said = f"something between two pieces, {gap_m:.2f} m apart, {DoubtKind.COVERS_PART.value}"
        return [Doubt(DoubtKind.COVERS_PART, said)]
    return list_hidden_gaps(gap_m)


def _at_end(doubt: Doubt, end: int) -> Doubt:
    """Transfer a doubt about an end of a piece to an end of the whole; leave other doubts as they are."""
    if doubt.end is None:
        return doubt
    return replace(doubt, sentence=doubt.sentence.replace(ENDS[doubt.end], ENDS[end]), end=end)
