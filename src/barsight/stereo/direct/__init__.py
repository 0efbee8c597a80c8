"""Implement Barsight's own stereo method: a semi-global start, then direct refinement along the bars."""
