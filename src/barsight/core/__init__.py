"""Errors, frozen types, poses that know their frames, time stamps, uncertainty, atomic files."""
