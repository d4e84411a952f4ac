"""What commands show in a terminal: tables of results, progress, the live table of a skin, keys.

rich is used here. Nothing is computed and nothing is read from ROS here: functions are given what
they show.
"""
