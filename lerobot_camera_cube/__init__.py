# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A skin as a camera of LeRobot: ``lerobot-record --robot.cameras='{skin: {type: cube, …}}'``.

LeRobot imports this package because of its name, and finds `CubeCamera` by the name of its
configuration (`register_third_party_plugins` and `make_device_from_device_class` in
lerobot/utils/import_utils.py, version 0.4.4).
"""

from .camera import CubeCamera, CubeCameraConfig

__all__ = ["CubeCamera", "CubeCameraConfig"]
