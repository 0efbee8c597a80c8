"""Provide the commands on a measured yard: choose and explain lifts, compare, view and export it."""
