"""Provide the command line: thin wiring, one file per command."""
