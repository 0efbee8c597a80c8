"""Writers of recordings: EuRoC folders and ROS bags."""
