"""Stereo benchmarks: Middlebury pairs, rendered bars, speed."""
