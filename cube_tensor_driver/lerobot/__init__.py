"""Bags as a LeRobot data set (LeRobotDataset v3.0): Parquet files and metadata for learning.

The stress comes from `bags.reprocess`; how a data set is laid out is decided here. Neither ROS nor
the package `lerobot` is imported.
"""
