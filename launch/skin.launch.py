"""All cubes of a skin file, on real or simulated hubs.

Starts driver and reconstruction, and on demand what shows and records the skin.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from cube_tensor_driver.ros.launching import start_skin, switch


def text(name: str, description: str, default: str = "") -> DeclareLaunchArgument:
    return DeclareLaunchArgument(name, default_value=default, description=description)


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(
            "config", description="Skin file (YAML): links, cubes, poses, calibrations."
        ),
        text("namespace", "Namespace of the nodes and their topics."),
        text("rate", "Samples per second; 0.0: as in the skin file.", "0.0"),
        text("publish_period", "Time that one message covers, s; 0.0: one for each scan.", "0.0"),
        switch(
            "simulate", "Simulate the skin's hubs on pseudo-terminals instead of opening its ports."
        ),
        text("load", "Load script (YAML) for the simulated skin; empty: a load that wanders."),
        switch("composed", "Driver and reconstruction in one process: less CPU and latency."),
        switch(
            "autostart",
            "Nodes configure and activate themselves; false: others do it (lifecycle).",
            default="true",
        ),
        switch("contacts", "Publish where and how hard the skin is touched on `contacts`."),
        switch("markers", "Publish the skin as a MarkerArray on `markers`."),
        switch(
            "state_publisher",
            "Publish the cubes' frames (robot_state_publisher with the URDF of the skin).",
        ),
        switch("record", "Record frequencies, stress and info into a bag with ros2 bag (mcap)."),
        switch("rviz", "Show the skin in RViz; starts markers and state_publisher too."),
    ]
    values = {argument.name: LaunchConfiguration(argument.name) for argument in arguments}
    return LaunchDescription([*arguments, OpaqueFunction(function=start_skin, kwargs=values)])
