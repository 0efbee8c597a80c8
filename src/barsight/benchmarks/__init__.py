"""Floor 7: benchmarks that compare methods in one run and print a table."""
