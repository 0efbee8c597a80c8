"""From stereo pairs to the yard's map: matched, placed, fused and joined, each step kept to go on from."""
