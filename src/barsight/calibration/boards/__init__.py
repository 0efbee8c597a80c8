"""Describe calibration boards, detect them in pictures and model their warp."""
