"""Provide the commands on the store: add a survey, list, verify, and show the yard at a time."""
