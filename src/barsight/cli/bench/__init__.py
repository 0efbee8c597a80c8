"""`barsight bench NAME ...`: one module per group of benchmarks."""
