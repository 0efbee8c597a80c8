"""Floor 6: measured results against truth."""
