"""Compare methods in one run and print a table."""
