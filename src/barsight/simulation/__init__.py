"""Render recordings with exact ground truth."""
