"""Messages as plain data: the codec of the batch messages, the description of a skin, contacts.

Nodes and bags share this folder, so it imports neither ROS nor a library for bags.
"""
