"""Model cameras, projection, stereo rigs, rectification and IMU noise."""
