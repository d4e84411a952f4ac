"""Names of the message types that the package uses."""

from __future__ import annotations

PACKAGE = "cube_tensor_driver"
FREQUENCIES = f"{PACKAGE}/msg/SkinFrequencies"
STRESS = f"{PACKAGE}/msg/SkinStress"
INFO = f"{PACKAGE}/msg/SkinInfo"
CONTACTS = f"{PACKAGE}/msg/SkinContacts"
TRACTION = "sensor_msgs/msg/PointCloud2"
