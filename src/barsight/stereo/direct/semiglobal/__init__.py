"""Match semi-globally in 8-bit integers: the direct method's start."""
