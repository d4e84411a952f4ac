"""Checks of torture: what a skin published, compared with what its simulated hubs did.

One comparison per file; `verdict.py` puts them together. What was sent comes from the sample log,
what arrived from a record of both topics. What the driver counts is a claim that is checked.
Nothing here imports ROS.
"""
