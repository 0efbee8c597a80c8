"""Read the sensors of a crane: cameras, IMU and encoders, each with its clock."""
