"""Floor 2: feature points and their matching."""
