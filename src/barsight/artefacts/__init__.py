"""Describe the artefacts of an acceptance: plates, spheres, bars, steps, dummy bundles, limits."""
