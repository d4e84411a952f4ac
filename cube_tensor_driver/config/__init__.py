"""Files that people write and the program checks: skins, calibrations, tares, load scripts.

A file is checked completely before anything starts, and each mistake is named with file and key.
Recordings are not here but in bags/. The parameters of the nodes are here too, because commands
without ROS take them as options.
"""
