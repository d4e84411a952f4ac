"""All cubes of a skin file, on real hubs or simulated ones: driver, reconstruction, what there is
to see and keep."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from cube_tensor_driver.ros.launching import start_skin, switch


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(
            "config", description="Skin file (YAML): links, cubes, poses, calibrations."
        ),
        DeclareLaunchArgument(
            "namespace", default_value="", description="Namespace of the nodes and their topics."
        ),
        DeclareLaunchArgument(
            "rate",
            default_value="0.0",
            description="Samples per second; 0.0: as the skin file says.",
        ),
        DeclareLaunchArgument(
            "publish_period",
            default_value="0.0",
            description="Time that one message covers, s; 0.0: one for each scan.",
        ),
        switch(
            "simulate", "Simulate the skin's hubs on pseudo-terminals instead of opening its ports."
        ),
        DeclareLaunchArgument(
            "load",
            default_value="",
            description="Load script (YAML) of the simulated skin; empty: something wanders.",
        ),
        switch("composed", "Driver and reconstruction in one process: less CPU and latency."),
        switch(
            "autostart",
            "Nodes configure and activate themselves; false: by lifecycle transitions from elsewhere.",
            "true",
        ),
        switch("contacts", "Publish where and how hard the skin is touched on `contacts`."),
        switch("markers", "Publish the skin as a MarkerArray on `markers`."),
        switch(
            "state_publisher",
            "Publish the cubes' frames (robot_state_publisher, URDF of the skin file).",
        ),
        switch("record", "Record frequencies, stress and info into a bag with ros2 bag (mcap)."),
        switch("rviz", "Show the skin in RViz; starts markers and state_publisher too."),
    ]
    values = {argument.name: LaunchConfiguration(argument.name) for argument in arguments}
    return LaunchDescription([*arguments, OpaqueFunction(function=start_skin, kwargs=values)])
