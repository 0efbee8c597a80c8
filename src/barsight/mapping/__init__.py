"""Floor 4: all views fused into one height surface, and contours cut from it."""
