"""Draw whole worlds from a seed: piles settled by physics, what stands about, crane, light, faults."""
