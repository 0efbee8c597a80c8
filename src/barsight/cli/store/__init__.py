"""Commands on the store: add a survey, list, verify, and the yard at a time."""
