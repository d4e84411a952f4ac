"""Recordings (bags): rosbag2's files are read, written and repaired here without ROS or rosbag2."""
