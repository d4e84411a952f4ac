"""Which processes a skin needs, and how they are started, watched and ended. ROS is not imported."""
