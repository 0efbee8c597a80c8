"""Calibrate a stereo rig by bundle adjustment, with outlier removal, uncertainty and a verdict."""
