"""ROS 1 and ROS 2 bags as logs: read without a ROS installation, by the package `rosbags`."""
