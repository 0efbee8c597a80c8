"""Estimate IMU noise and calibrate cameras against an IMU with a continuous-time spline."""
