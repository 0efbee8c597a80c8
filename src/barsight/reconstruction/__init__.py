"""Reconstruct the yard's map from stereo pairs: match, locate, fuse and join, with a checkpoint after each
step.
"""
