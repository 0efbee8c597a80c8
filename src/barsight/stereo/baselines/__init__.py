"""Provide published stereo methods for comparison, and the parts that only they use."""
