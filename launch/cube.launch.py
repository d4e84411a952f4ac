"""A single cube on one port: skin.launch.py, with all its arguments, for the skin file of one."""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

from cube_tensor_driver.ros.launching import SINGLE_CUBE, SKIN_LAUNCH, declare_text


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            declare_text("config", "Skin file (YAML) with one link.", str(SINGLE_CUBE)),
            IncludeLaunchDescription(PythonLaunchDescriptionSource(str(SKIN_LAUNCH))),
        ]
    )
