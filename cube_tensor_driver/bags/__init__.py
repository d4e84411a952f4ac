"""Recordings: rosbag2 folders read, written, repaired and reprocessed without rosbag2.

The codec of the batch messages is here too, because nodes and bags share it. ROS is not imported.
"""
