"""ROS 2: nodes and message conversions, thin; what they carry is made in the layers below."""
