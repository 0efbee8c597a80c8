"""Stereo calibration: bundle adjustment, outliers, uncertainty, verdict."""
