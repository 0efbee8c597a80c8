"""Published stereo methods to compare with, and the parts that only they use."""
