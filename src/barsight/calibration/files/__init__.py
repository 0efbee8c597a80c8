"""Read and write rig and IMU files: Barsight's own, Kalibr's, OpenCV's and EuRoC's."""
