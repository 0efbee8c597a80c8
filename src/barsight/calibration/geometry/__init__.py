"""Camera models, projection, stereo rigs, rectification and the IMU's noise model."""
