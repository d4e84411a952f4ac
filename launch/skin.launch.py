"""Driver and reconstruction for all cubes of a skin file, on real hubs or on simulated ones."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from cube_tensor_driver.ros.launching import start_skin


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument("config", description="Skin file (YAML): links, cubes, poses, calibrations."),
        DeclareLaunchArgument(
            "simulate",
            default_value="false",
            choices=["true", "false"],
            description="Simulate the hubs of the skin file on pseudo-terminals instead of opening its ports.",
        ),
        DeclareLaunchArgument(
            "rate", default_value="0.0", description="Samples per second; 0.0: as the skin file says."
        ),
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of the nodes and their topics."),
    ]
    values = {name: LaunchConfiguration(name) for name in ("config", "simulate", "rate", "namespace")}
    return LaunchDescription([*arguments, OpaqueFunction(function=start_skin, kwargs=values)])
