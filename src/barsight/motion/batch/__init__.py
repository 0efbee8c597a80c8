"""Estimate in batch: full bundle adjustment over cameras, IMU and encoders."""
