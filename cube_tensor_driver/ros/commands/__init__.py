"""Functions of the commands that need ROS: record, replay, echo, list topics, call services."""
