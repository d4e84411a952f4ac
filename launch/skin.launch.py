"""All cubes of a skin file, on real or simulated hubs.

Starts driver and reconstruction, and on demand what shows and records the skin.
"""

from typing import Any

from launch import LaunchDescription
from launch.actions import ExecuteProcess, OpaqueFunction
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, OrSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import ExecutableInPackage

from cube_tensor_driver.config.urdf import skin_urdf
from cube_tensor_driver.ros.launching import (
    DEMO_LOAD,
    FromSkin,
    GivenParameters,
    check_arguments,
    record_skin,
    rviz_file,
    switch,
    text,
)

PACKAGE = "cube_tensor_driver"
RESPAWN_DELAY_S = 2.0

given = LaunchConfiguration


def generate_launch_description() -> LaunchDescription:
    arguments = [
        text("config", "Skin file (YAML); empty with simulate:=true: the demo skin."),
        text("namespace", "Namespace of the nodes and their topics, below any that is pushed."),
        text("port", "Port of the hub instead of the file's, for a skin with one link."),
        text("rate", "Samples per second; empty: as the parameter says."),
        text("publish_period", "Time that one message covers, s; empty: as the parameter says."),
        switch("simulate", "Simulate the skin's hubs instead of opening its ports."),
        text("load", "Load script (YAML) for a simulated skin.", str(DEMO_LOAD)),
        switch("composed", "Driver and reconstruction in one process: less CPU and latency."),
        switch("autostart", "Nodes configure and activate themselves (lifecycle).", ""),
        switch("respawn", "Start a node again that has ended by itself.", "true"),
        switch("contacts", "Publish where and how hard the skin is touched on `contacts`."),
        switch("markers", "Publish the skin as a MarkerArray on `markers`."),
        switch("state_publisher", "Publish the cubes' frames (robot_state_publisher)."),
        switch("record", "Record the skin with ros2 bag into a new folder here (mcap)."),
        switch("rviz", "Show the skin in RViz; starts markers and state_publisher too."),
    ]
    autostart = ParameterFile(GivenParameters("autostart"))
    reconstruction = ParameterFile(GivenParameters("autostart", "config", "publish_period"))
    driver = ParameterFile(
        GivenParameters("autostart", "config", "publish_period", "port", "rate", "port_directory")
    )
    separate, composed = UnlessCondition(given("composed")), IfCondition(given("composed"))
    urdf = {"robot_description": ParameterValue(FromSkin(skin_urdf), value_type=str)}
    return LaunchDescription(
        [
            *arguments,
            OpaqueFunction(function=check_arguments),
            simulator(),
            node("reconstruction", reconstruction, separate),
            node("driver", driver, separate),
            node("composed", driver, composed),
            node("contacts", autostart, IfCondition(given("contacts"))),
            node("markers", autostart, wanted("markers", "rviz")),
            OpaqueFunction(function=record_skin, condition=wanted("record")),
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                namespace=given("namespace"),
                parameters=[urdf],
                output="screen",
                condition=wanted("state_publisher", "rviz"),
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=given("namespace"),
                arguments=["-d", FromSkin(rviz_file)],
                condition=wanted("rviz"),
            ),
        ]
    )


def wanted(argument: str, other: str | None = None) -> IfCondition:
    """If one of the arguments is true."""
    return IfCondition(OrSubstitution(given(argument), given(other or argument)))


def node(executable: str, parameters: Any, condition: Any) -> Node:
    """A node of this package. `composed` holds several, which keep their own names."""
    return Node(
        package=PACKAGE,
        executable=executable,
        name=None if executable == "composed" else executable,
        namespace=given("namespace"),
        parameters=[parameters],
        condition=condition,
        output="screen",
        emulate_tty=True,
        respawn=given("respawn"),
        respawn_delay=RESPAWN_DELAY_S,
    )


def simulator() -> ExecuteProcess:
    """The hubs of the skin; not a ROS node."""
    return ExecuteProcess(
        cmd=[
            ExecutableInPackage("simulator", PACKAGE),
            *("--config", given("config")),
            *("--ports", given("port_directory")),
            *("--load", given("load")),
        ],
        name="simulator",
        condition=IfCondition(given("simulate")),
        output="screen",
    )
