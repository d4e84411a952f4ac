"""From the bytes of hubs to `FrequencyRows`: protocol, links, clocks, accounts, scans.

The live source (`open_links`) puts them together. Nothing here knows ROS, and nothing looks at what
a frequency means.
"""
