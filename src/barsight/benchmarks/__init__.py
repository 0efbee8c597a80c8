"""Compare methods in one run and tabulate the results."""
