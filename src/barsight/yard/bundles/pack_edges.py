"""Hold fitted outlines off the packs beside them: where straps and flanks show a pack, no other is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.yard.types import Bundle, Doubt, DoubtKind

DOUBTFUL = 0.4
"""The most confidence in an outline that straps, or their absence, or the floor speak against."""
_SKEW, _BESIDE_M, _LEVEL_RATIO = 0.05, 0.3, 0.3
"""Sine of the skew, length beside each other, and height between axes over the mean width: within these two
bundles lie side by side."""
_NARROWEST_M = 0.04
_SLIGHT_M = 0.015
"""An outline that reaches so little into a pack is not doubtful for that."""


def hold_off(bundles: list[Bundle], packs: list[bool]) -> list[Bundle]:
    """Cut the outlines that reach into a pack at its edge. packs: which of them are seen whole."""
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
    """Check whether a bundle lies beside a pack, at about its height, its axis outside of it."""
    away = one.centre_m - pack.centre_m
    along = np.array([-np.sin(pack.yaw_rad), np.cos(pack.yaw_rad)])
    beside = abs(float(away[0] * along[1] - away[1] * along[0]))
    common = (one.length_m + pack.length_m) / 2 - abs(float(away[:2] @ along))
    level = abs(float(away[2])) < _LEVEL_RATIO * (one.width_m + pack.width_m) / 2
    parallel = abs(float(np.sin(one.yaw_rad - pack.yaw_rad))) < _SKEW
    return parallel and level and beside > pack.width_m / 2 and common > _BESIDE_M
