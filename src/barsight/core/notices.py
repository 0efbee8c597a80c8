"""All warnings of a measurement: one table of codes, and one of those that forbid every lift."""

from __future__ import annotations

from dataclasses import dataclass

WARNINGS = {
    "assumed": "The recording doesn't say something, or says it in part; the message names the assumption.",
    "calibration": "The calibration is doubtful: rows of the pictures don't match as it says.",
    "calibration-drift": "The crane's travel contradicts the calibration; no lift is offered.",
    "frames-refused": "Frames were refused; `frames.refused` gives each one's stamp, stage and reason.",
    "laser-frame": "Without a crane the map isn't in the laser's yard, so there is no agreement.",
    "laser-askew": "A laser profile doesn't run along X of the yard, so it isn't compared or fused.",
    "laser-off": "A laser profile contradicts vision, or couldn't be told off: it isn't fused into the map.",
    "live-state": "The live run ended in a mode that forbids lifts; the message says why.",
    "mounting-doubtful": "Gravity or floor contradict the stated mounting; no lift is offered.",
    "no-overlap": "A laser profile and the map share fewer than two points, so there is no agreement for it.",
    "one-view": "One frame made the map, so no height is confirmed by another; no lift is offered.",
    "passes-contradict": "Two passes lie further apart than their sigmas allow; no lift is offered.",
    "passes-untied": "A pass shares no surface with another: its place beside them is the encoders' alone.",
    "stock-contradicts": "Half of the stock list or more contradicts the map; no lift is offered.",
    "stock-list": "Stock list and map disagree, or the map can't tell; bundles that disagree aren't offered.",
    "trajectory": "Sensors contradict each other here and there; the message says which.",
    "trajectory-degraded": "Readings or sensors were left out of the trajectory; no lift is offered.",
    "units-doubtful": "A sensor's numbers are of a size that can't be; no lift is offered.",
    "yard-changed": "The yard changed between two passes; the newer one counts there.",
}
"""Code to what it means."""

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
"""Code of a warning that forbids every lift to the veto's code."""


@dataclass(frozen=True)
class Notice:
    """A warning: `code` of `WARNINGS`, `message` a sentence."""

    code: str
    message: str
