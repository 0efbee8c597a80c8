"""Benchmarks of whole yards: the field test, bundles, lifts, and run time on a long yard."""
