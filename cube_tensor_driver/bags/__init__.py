"""Recordings: rosbag2 folders read, written and repaired without rosbag2. ROS is not imported."""
