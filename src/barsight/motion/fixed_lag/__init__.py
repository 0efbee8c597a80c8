"""The fixed-lag smoother: poses while the crane travels."""
