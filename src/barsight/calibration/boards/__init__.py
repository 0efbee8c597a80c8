"""Calibration boards, their detection and their warp."""
