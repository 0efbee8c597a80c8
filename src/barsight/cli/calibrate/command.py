"""Dispatch `barsight calibrate KIND ...` to the requested calibration."""

from __future__ import annotations

from collections.abc import Sequence

from barsight.cli.arguments import pass_on

KINDS = {
    "board": "Draw a calibration board to print at true size, or how to hold it in front of the cameras",
    "stereo": "Calibrate two cameras from pictures of a board: rig file, and a report with a verdict",
    "camera-imu": "Calibrate the cameras' mounting on the IMU, and the clocks' offset, from a recording",
    "check": "Check if the rig has drifted, from ordinary crane travel",
    "export": "Write a rig in another format: Barsight's, Kalibr's, OpenCV's, EuRoC's",
    "yard": "Register the measurement's frame in the yard, from surveyed targets, tags or crane moves",
    "magnet": "Find the magnet's offset from the crane's readings, from a certificate's touch-downs",
    "imu-noise": "Fit the noise model of an IMU from a log at rest: imu.yaml",
}


def run(arguments: Sequence[str]) -> None:
    """Pass the remaining arguments on to the calibration named first."""
    pass_on("calibrate", "calibration", KINDS, arguments)
