"""Estimate the body's trajectory from cameras, IMU and encoders."""
