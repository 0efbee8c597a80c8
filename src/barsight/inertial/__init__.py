"""Floor 2: what an IMU measures, its integration between two instants, and standing still."""
