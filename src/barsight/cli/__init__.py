"""Floor 8: the command line; thin wiring, one file per command."""
