"""Cut fitted outlines back at the edges of packs beside them: no other bundle is where a pack is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.yard.types import Bundle, Doubt, DoubtKind

DOUBTFUL = 0.4
"""Maximum confidence in an outline that is contradicted by straps, by their absence or by the floor."""
_SKEW, _BESIDE_M, _LEVEL_RATIO = 0.05, 0.3, 0.3
"""Limits within which two bundles lie side by side: maximum sine of the skew, minimum length beside each
other (m), maximum difference in height in mean widths.
"""
_NARROWEST_M = 0.04
_SLIGHT_M = 0.015
"""Maximum depth (m) to which an outline may reach into a pack without being doubtful for it."""


def hold_off(bundles: list[Bundle], packs: list[bool]) -> list[Bundle]:
    """Cut outlines that reach into a pack at its edge. packs: which bundles are packs with known bounds."""
    seen = [bundle for bundle, is_pack in zip(bundles, packs, strict=True) if is_pack]
    return [
        bundle if is_pack else _cut_at(bundle, seen) for bundle, is_pack in zip(bundles, packs, strict=True)
    ]


def _cut_at(bundle: Bundle, packs: list[Bundle]) -> Bundle:
    across = np.array([np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad), 0.0])
    for pack in packs:
        away = pack.centre_m - bundle.centre_m
        beside = float(away @ across)
        reach = (bundle.width_m + pack.width_m) / 2 - abs(beside)
        left = bundle.width_m - reach
        if reach <= 0 or left < _NARROWEST_M or not _side_by_side(bundle, pack):
            continue
        if reach > _SLIGHT_M:
            said = f"its outline reaches {1e3 * reach:.0f} mm into a bundle that straps hold"
            bundle = replace(
                bundle, bars=None, section_m2=np.nan, confidence=min(bundle.confidence, DOUBTFUL),
                reasons=(*bundle.reasons, Doubt(DoubtKind.OTHER, said)),
                sigma=replace(bundle.sigma, section_m2=np.nan),
            )  # fmt: skip
        aside = -np.sign(beside) * reach / 2 * across
        sigma = replace(
            bundle.sigma,
            lateral_m=max(bundle.sigma.lateral_m, pack.sigma.lateral_m),
            width_m=max(bundle.sigma.width_m, pack.sigma.width_m),
        )
        bundle = replace(
            bundle, centre_m=bundle.centre_m + aside, ends_m=bundle.ends_m + aside, width_m=left, sigma=sigma
        )
    return bundle


def _side_by_side(one: Bundle, pack: Bundle) -> bool:
    """Check whether a bundle lies beside a pack, at about its height, with its axis outside of the pack."""
    away = one.centre_m - pack.centre_m
    along = np.array([-np.sin(pack.yaw_rad), np.cos(pack.yaw_rad)])
    beside = abs(float(away[0] * along[1] - away[1] * along[0]))
    common = (one.length_m + pack.length_m) / 2 - abs(float(away[:2] @ along))
    level = abs(float(away[2])) < _LEVEL_RATIO * (one.width_m + pack.width_m) / 2
    parallel = abs(float(np.sin(one.yaw_rad - pack.yaw_rad))) < _SKEW
    return parallel and level and beside > pack.width_m / 2 and common > _BESIDE_M
