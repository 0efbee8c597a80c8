"""Fuse all views into one height surface, and cut contours from it."""
