"""Judge lifts from exact geometry alone; nothing here imports the code that it judges."""
