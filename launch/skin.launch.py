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
    declare_switch,
    declare_text,
    record_skin,
    rviz_file,
)

PACKAGE = "cube_tensor_driver"

RESPAWN_DELAY_S = 2.0
"""Time, in seconds, after which a node that has ended by itself starts again."""

ARGUMENTS = (
    declare_text("config", "Skin file (YAML); empty with simulate:=true: the demo skin."),
    declare_text("namespace", "Namespace of the nodes and their topics, below any that is pushed."),
    declare_text("port", "Port of the hub instead of the file's, for a skin with one link."),
    declare_text("rate", "Samples per second; empty: as the parameter says."),
    declare_text(
        "publish_period", "Time that one message covers, s; empty: as the parameter says."
    ),
    declare_switch("simulate", "Simulate the skin's hubs instead of opening its ports."),
    declare_text("load", "Load script (YAML) for a simulated skin.", str(DEMO_LOAD)),
    declare_switch("composed", "Driver and reconstruction in one process: less CPU and latency."),
    declare_switch("autostart", "Nodes configure and activate themselves (lifecycle).", ""),
    declare_switch("respawn", "Start a node again that has ended by itself.", "true"),
    declare_switch("contacts", "Publish where and how hard the skin is touched on `contacts`."),
    declare_switch("markers", "Publish the skin as a MarkerArray on `markers`."),
    declare_switch("state_publisher", "Publish the cubes' frames (robot_state_publisher)."),
    declare_switch("record", "Record the skin with ros2 bag into a new folder here (mcap)."),
    declare_switch("rviz", "Show the skin in RViz; starts markers and state_publisher too."),
)


def generate_launch_description() -> LaunchDescription:
    autostart = ParameterFile(GivenParameters("autostart"))
    reconstruction = ParameterFile(GivenParameters("autostart", "config", "publish_period"))
    driver = ParameterFile(
        GivenParameters("autostart", "config", "publish_period", "port", "rate", "port_directory")
    )
    is_composed = LaunchConfiguration("composed")
    return LaunchDescription(
        [
            *ARGUMENTS,
            OpaqueFunction(function=check_arguments),
            make_simulator(),
            make_node("reconstruction", reconstruction, UnlessCondition(is_composed)),
            make_node("driver", driver, UnlessCondition(is_composed)),
            make_node("composed", driver, IfCondition(is_composed)),
            make_node("contacts", autostart, if_any("contacts")),
            make_node("markers", autostart, if_any("markers", "rviz")),
            OpaqueFunction(function=record_skin, condition=if_any("record")),
            make_state_publisher(),
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=LaunchConfiguration("namespace"),
                arguments=["-d", FromSkin(rviz_file)],
                condition=if_any("rviz"),
            ),
        ]
    )


def if_any(argument: str, other: str | None = None) -> IfCondition:
    """Return the condition that one of these launch arguments is true."""
    first, second = LaunchConfiguration(argument), LaunchConfiguration(other or argument)
    return IfCondition(OrSubstitution(first, second))


def make_node(executable: str, parameters: Any, condition: Any) -> Node:
    """Return a node of this package."""
    # The process `composed` holds several nodes, which keep their own names.
    name = None if executable == "composed" else executable
    return Node(
        package=PACKAGE,
        executable=executable,
        name=name,
        namespace=LaunchConfiguration("namespace"),
        parameters=[parameters],
        condition=condition,
        output="screen",
        emulate_tty=True,
        respawn=LaunchConfiguration("respawn"),
        respawn_delay=RESPAWN_DELAY_S,
    )


def make_state_publisher() -> Node:
    """Return the node that publishes the frames of the cubes."""
    urdf = ParameterValue(FromSkin(skin_urdf), value_type=str)
    return Node(
        package="robot_state_publisher",
        executable="robot_state_publisher",
        namespace=LaunchConfiguration("namespace"),
        parameters=[{"robot_description": urdf}],
        output="screen",
        condition=if_any("state_publisher", "rviz"),
    )


def make_simulator() -> ExecuteProcess:
    """Return the process of the skin's simulated hubs, which is no ROS node."""
    return ExecuteProcess(
        cmd=[
            ExecutableInPackage("simulator", PACKAGE),
            *("--config", LaunchConfiguration("config")),
            *("--ports", LaunchConfiguration("port_directory")),
            *("--load", LaunchConfiguration("load")),
        ],
        name="simulator",
        condition=IfCondition(LaunchConfiguration("simulate")),
        output="screen",
    )
