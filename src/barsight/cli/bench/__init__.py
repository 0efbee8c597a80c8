"""Run `barsight bench NAME ...`, with one module per group of benchmarks."""
