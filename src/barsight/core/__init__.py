"""Provide errors, records, poses that know their frames, time stamps, settings, and atomic files."""
