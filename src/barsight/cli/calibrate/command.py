"""Dispatch `barsight calibrate KIND ...` to the requested calibration."""

from __future__ import annotations

from collections.abc import Sequence

from barsight.cli.arguments import pass_on

KINDS = {
    "board": "Draw a board to print in its true size, or how to hold it before the cameras",
    "stereo": "Calibrate two cameras from pictures of a board: rig.yaml and a report that judges it",
    "camera-imu": "Where the cameras sit on the IMU and the clocks' offset, from a recording with a board",
    "check": "Has the rig drifted? Ordinary crane travel shows it, with sigma and cost in mm",
    "export": "Write a rig in another format: ours, Kalibr, OpenCV, EuRoC",
    "yard": "Where the world lies in the yard, from surveyed targets or crane moves in two axes",
    "magnet": "How the magnet hangs off the crane's readings, from the touch-downs of a certificate",
    "imu-noise": "Noise densities and random walks of an IMU from a log at rest: imu.yaml",
}


def run(arguments: Sequence[str]) -> None:
    """Pass the remaining arguments on to the calibration named first."""
    pass_on("calibrate", "calibration", KINDS, arguments)
