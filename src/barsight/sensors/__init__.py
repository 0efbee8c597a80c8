"""Sensors beside the crane: cameras, IMU and encoders, each with its clock."""
