"""Measuring while the crane travels: capture, track and map are processes under a supervisor."""
