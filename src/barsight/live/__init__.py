"""Measure while the crane travels: capture, tracking and mapping are processes under a supervisor."""
