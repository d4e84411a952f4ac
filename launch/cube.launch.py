"""Driver and reconstruction for a single cube on one port."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from cube_tensor_driver.config.package_data import package_data
from cube_tensor_driver.ros.launching import start_skin


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(
            "port",
            default_value="",
            description="Port of the hub, such as /dev/ttyACM0 or socket://host:port; empty: as the skin file says.",
        ),
        DeclareLaunchArgument(
            "config",
            default_value=str(package_data() / "config" / "cube.yaml"),
            description="Skin file (YAML) with one link.",
        ),
        DeclareLaunchArgument(
            "namespace", default_value="", description="Namespace of the nodes and their topics."
        ),
    ]
    values = {name: LaunchConfiguration(name) for name in ("config", "port", "namespace")}
    return LaunchDescription([*arguments, OpaqueFunction(function=start_skin, kwargs=values)])
