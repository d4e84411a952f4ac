"""What commands do in the ROS graph: record, replay, listen, tare, list topics, set parameters."""
