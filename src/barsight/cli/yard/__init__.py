"""Commands on a measured yard: lifts, their reasons, changes between two."""
