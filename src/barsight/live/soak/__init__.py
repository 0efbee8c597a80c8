"""Monitor a live run for hours or weeks: memory, descriptors, faults."""
