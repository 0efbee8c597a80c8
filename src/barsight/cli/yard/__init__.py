"""Commands on a measured yard: lifts, their reasons, changes between two, how it is shown and handed on."""
