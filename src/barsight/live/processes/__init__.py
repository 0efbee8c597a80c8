"""The processes of a live run, each with one task."""
