"""Draw whole worlds from a seed: piles settled by physics, surrounding objects, crane, light, faults."""
