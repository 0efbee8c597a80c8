"""Truth, tables and benchmarks."""
