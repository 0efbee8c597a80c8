"""Judge lifts by exact geometry alone; nothing here imports what it judges."""
