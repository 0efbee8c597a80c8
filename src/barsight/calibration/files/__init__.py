"""Rig and IMU files: Barsight's own, Kalibr's, OpenCV's, EuRoC's."""
