"""Errors, records, poses that know their frames, time stamps, uncertainty, atomic files."""
