"""The list of processes that a skin needs, and the code that starts, watches and ends them.

Nothing in this folder imports ROS: nodes are started as commands. The nodes are in ros/nodes/.
"""
