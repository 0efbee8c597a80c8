"""Floor 6: rendered recordings with exact truth."""
