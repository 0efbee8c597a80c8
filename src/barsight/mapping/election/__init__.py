"""Elect the whole surface, tile by tile, repeatedly while views arrive."""
