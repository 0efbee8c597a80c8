"""Floor 2: rigid motions between matched points."""
