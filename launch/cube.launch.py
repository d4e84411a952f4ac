# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Starts a single cube on one port.

It includes skin.launch.py and takes the same arguments; the default of `config` is the skin file of
a single cube.
"""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

from cube_tensor_driver.ros.launching import SINGLE_CUBE, SKIN_LAUNCH, declare_text


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            declare_text("config", "Path of a skin file (YAML) with one link.", str(SINGLE_CUBE)),
            IncludeLaunchDescription(PythonLaunchDescriptionSource(str(SKIN_LAUNCH))),
        ]
    )
