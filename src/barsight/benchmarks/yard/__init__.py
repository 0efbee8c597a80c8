"""Benchmarks of whole yards: the field test, bundles, lifts, length."""
