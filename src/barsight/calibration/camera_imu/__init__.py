"""IMU noise and camera-IMU calibration on a continuous-time spline."""
