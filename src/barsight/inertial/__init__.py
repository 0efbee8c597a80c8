"""Integrate the IMU between two instants, and detect standstill."""
