"""Score measured results against ground truth."""
