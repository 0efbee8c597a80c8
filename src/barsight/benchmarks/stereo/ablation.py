"""Ablate our own stereo (`bench ablation`): one part left out at a time."""

from __future__ import annotations

from dataclasses import replace

from barsight.stereo.direct.pipeline import BarsightSettings, BarsightStereo
from barsight.stereo.method import StereoMethod


def without_one_part() -> dict[str, StereoMethod]:
    """Build the complete method, and variants of it, each under the name of the part that it lacks."""
    whole = BarsightSettings()
    refinement = whole.refinement
    variants = {
        "whole": whole,
        "no refinement": replace(whole, refinement=replace(refinement, steps=0)),
        "no short support": replace(whole, refinement=replace(refinement, short_px=0.0)),
        "no care for gloss": replace(whole, refinement=replace(refinement, gloss_px=0.0)),
        "no left-right check": replace(whole, consistency_px=1e6),
        "no guesses": replace(whole, fill_occlusions=False),
        "preset fast": replace(whole, preset="fast"),
    }
    return {name: BarsightStereo(settings) for name, settings in variants.items()}
