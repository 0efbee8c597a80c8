"""Score measured results against truth."""
