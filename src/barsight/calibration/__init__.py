"""Calibrate cameras, stereo rigs and IMUs, and rectify pictures."""
