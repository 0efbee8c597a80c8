"""All warnings of a measurement: one table of codes, and one of those that forbid every lift."""

from __future__ import annotations

from dataclasses import dataclass

WARNINGS = {
    "assumed": "The recording lacks something; the message names the assumption.",
    "calibration": "The rows of the rectified pictures don't match the calibration; no lift is offered.",
    "calibration-drift": "Travel or pictures contradict the calibration; no lift is offered.",
    "frames-refused": "Frames were refused; `frames.refused` lists each one's stamp, stage and reason.",
    "laser-frame": "Without crane positions the map isn't in the laser's frame, so they can't be compared.",
    "laser-askew": "A laser profile doesn't run along X of the yard, so it isn't compared or fused.",
    "laser-off": "A laser profile contradicts vision or can't be checked, and isn't fused into the map.",
    "live-state": "The live run ended in a state that forbids lifts; the message says why.",
    "mounting-doubtful": "Gravity or the floor contradicts the stated mounting; no lift is offered.",
    "no-overlap": "A laser profile and the map share fewer than two points, so they can't be compared.",
    "one-view": "The map was made by a single frame, so no height is confirmed; no lift is offered.",
    "passes-contradict": "Two passes disagree by more than their sigmas allow; no lift is offered.",
    "passes-untied": "A pass shares no surface with another, so only the encoders place it.",
    "profile-outside": "A contour's y (map.profile_y_m) lies outside the map, so the contour is empty.",
    "stock-contradicts": "At least half of the stock list contradicts the map; no lift is offered.",
    "stock-list": "Stock list and map disagree, or can't be compared; bundles that disagree aren't offered.",
    "trajectory": "Sensors contradict each other in places; the message says which.",
    "trajectory-degraded": "Readings or sensors were left out of the trajectory; no lift is offered.",
    "units-doubtful": "A sensor's readings have an impossible magnitude; no lift is offered.",
    "yard-changed": "The yard changed between two passes; the newer one counts there.",
}
"""Meaning of each code."""

FORBIDS = {
    "calibration": "calibration-drift",
    "calibration-drift": "calibration-drift",
    "live-state": "live-state",
    "mounting-doubtful": "mounting-doubtful",
    "one-view": "one-view",
    "passes-contradict": "trajectory-degraded",
    "stock-contradicts": "stock-list",
    "trajectory-degraded": "trajectory-degraded",
    "units-doubtful": "units-doubtful",
}
"""Veto that a warning's code leads to, for the warnings that forbid every lift."""


@dataclass(frozen=True)
class Notice:
    """A warning: `code` of `WARNINGS`, `message` a sentence."""

    code: str
    message: str
