"""What commands do in the ROS graph: record, replay, echo, list topics, call services."""
