"""Compiled image operations of the direct method: splines, box sums, pyramids."""
