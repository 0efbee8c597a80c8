"""All warnings of a measurement: one table of codes."""

from __future__ import annotations

WARNINGS = {
    "assumed": "The recording doesn't say something, or says it in part; the message names the assumption.",
    "calibration": "The calibration is doubtful: rows of the pictures don't match as it says.",
    "calibration-drift": "The crane's travel contradicts the calibration; no lift is offered.",
    "frames-refused": "Frames were refused; `frames.refused` gives each one's stamp, stage and reason.",
    "imu": "The IMU's samples look odd: check the unit that the message names.",
    "laser-frame": "Without a crane the map isn't in the laser's yard, so there is no agreement.",
    "no-overlap": "A laser profile and the map share fewer than two points, so there is no agreement for it.",
    "one-view": "One frame made the map, so no height is confirmed by another; no lift is offered.",
    "stock-list": "Stock list and map disagree, or the map can't tell.",
    "trajectory": "Sensors contradict each other, or readings were left out; the message says which.",
}
"""Code to what it means."""
