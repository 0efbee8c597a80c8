"""The settings of a simulated recording: frozen dataclasses, checked once, units in the names."""
