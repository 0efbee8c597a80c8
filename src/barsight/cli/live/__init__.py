"""Provide the commands of a live run at the crane."""
