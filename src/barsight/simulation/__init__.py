"""Render recordings with exact truth."""
