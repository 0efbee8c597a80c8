"""Smooth with a fixed lag: poses while the crane travels."""
