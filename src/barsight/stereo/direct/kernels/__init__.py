"""Implement the direct method's compiled image operations: splines, box sums, pyramids."""
