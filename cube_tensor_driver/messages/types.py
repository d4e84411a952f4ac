# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Names of the ROS message types whose messages the package publishes and records."""

from __future__ import annotations

PACKAGE = "cube_tensor_driver"
"""Name of the ROS package that defines the message types of skins, such as SkinStress."""
FREQUENCIES_TYPE = f"{PACKAGE}/msg/SkinFrequencies"
"""Type of the messages with the frequencies of the pads, which the driver publishes."""
STRESS_TYPE = f"{PACKAGE}/msg/SkinStress"
"""Type of the messages with stress and gradients, which the reconstruction node publishes."""
TOUCH_TYPE = f"{PACKAGE}/msg/SkinTouch"
"""Type of the messages with the touches of one scan, which the reconstruction node publishes."""
INFO_TYPE = f"{PACKAGE}/msg/SkinInfo"
"""Type of the message that describes a skin: names, poses and calibrations of its cubes."""
COMPENSATION_TYPE = f"{PACKAGE}/msg/SkinCompensation"
"""Type of the messages with the motion of the skin and the states of creep and temperature, which
the reconstruction has compensated."""
CONTACTS_TYPE = f"{PACKAGE}/msg/SkinContacts"
"""Type of the messages with the contacts on a skin."""
TRACTION_TYPE = "sensor_msgs/msg/PointCloud2"
"""Type of the messages of the topic `traction`: points on the surface with pressure and shear."""
