"""The batch estimator: full bundle adjustment over cameras, IMU and encoders."""
