"""Measure drift of the rig's calibration from ordinary crane travel."""
