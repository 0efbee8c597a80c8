"""Measuring beside the crane: capture, track and map as processes under a supervisor, from a recording so far."""
