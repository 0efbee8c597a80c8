"""Semi-global matching in bytes: the direct method's start."""
