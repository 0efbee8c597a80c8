"""Settings of a simulated recording: frozen dataclasses, validated once, with units in the names."""
