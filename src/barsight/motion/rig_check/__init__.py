"""Drift of the rig's calibration, measured from ordinary crane travel."""
