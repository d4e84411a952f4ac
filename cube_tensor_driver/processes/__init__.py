"""Which processes a skin needs, and child processes that are started, watched and ended.

Nothing here imports ROS: nodes are started as commands. What a node does is in ros/.
"""
