"""Physics of the cubic stress tensor sensor: numpy only, no I/O, no clock, no ROS."""
