"""Barsight's own stereo method: semi-global start, direct refinement along the bars."""
