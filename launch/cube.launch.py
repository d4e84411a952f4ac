"""Driver and reconstruction for a single cube on one port."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from cube_tensor_driver.config.package_data import package_data
from cube_tensor_driver.ros.launching import start_skin

PORT = "Port of the hub, such as /dev/ttyACM0 or socket://host:port; empty: as in the skin file."


def generate_launch_description() -> LaunchDescription:
    skin_file = str(package_data() / "config" / "cube.yaml")
    arguments = [
        DeclareLaunchArgument("port", default_value="", description=PORT),
        DeclareLaunchArgument(
            "config", default_value=skin_file, description="Skin file (YAML) with one link."
        ),
        DeclareLaunchArgument(
            "namespace", default_value="", description="Namespace of the nodes and their topics."
        ),
    ]
    values = {argument.name: LaunchConfiguration(argument.name) for argument in arguments}
    return LaunchDescription([*arguments, OpaqueFunction(function=start_skin, kwargs=values)])
