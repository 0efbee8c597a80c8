"""Chain relative poses: visual odometry and the paper's stitching."""
