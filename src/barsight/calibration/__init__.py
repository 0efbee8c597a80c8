"""Calibrate cameras, stereo rig and IMU; rectify pictures."""
