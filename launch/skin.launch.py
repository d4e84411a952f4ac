# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Starts all cubes of a skin file, on real or simulated hubs.

It starts the nodes `driver` and `reconstruction`. Arguments of the launch file add the nodes
`contacts` and `markers`, RViz, the frames of the cubes and a recording.
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
    stay_ended,
)

PACKAGE = "cube_tensor_driver"
"""ROS package that contains the executables of the nodes and of the simulator."""

RESPAWN_DELAY_S = 2.0
"""Time, in seconds, between the unexpected end of a node and its new start (`respawn:=true`)."""

ARGUMENTS = (
    declare_text(
        "config",
        "Path of the skin file (YAML). If it is empty and simulate is true, the demo skin is used.",
    ),
    declare_text(
        "namespace",
        "Namespace of the nodes and their topics, relative to the namespace that an including "
        "launch file has pushed.",
    ),
    declare_text("port", "Port that replaces the one in the skin file, which has a single link."),
    declare_text("rate", "Sampling rate in Hz. If it is empty, the parameter rate is not set."),
    declare_text(
        "publish_period",
        "Time, in s, whose scans are sent in one message. If it is empty, the parameter "
        "publish_period is not set.",
    ),
    declare_text(
        "frame_prefix",
        "Text in front of the frame ids of the skin and its cubes, such as left_. Two skins with "
        "the same skin file need different ones.",
    ),
    declare_switch(
        "forces",
        "Publish one force per cube on `forces`. If it is empty, the parameter forces is not set.",
        "",
    ),
    declare_switch("simulate", "Simulate the hubs of the skin instead of opening its ports."),
    declare_text(
        "load",
        "Path of the load script (YAML) that states the forces on a simulated skin.",
        str(DEMO_LOAD),
    ),
    declare_switch(
        "composed",
        "Run driver and reconstruction in one process, which takes less CPU and latency.",
    ),
    declare_switch(
        "autostart",
        "Let the nodes configure and activate themselves (lifecycle). If it is empty, the "
        "parameter autostart is not set.",
        "",
    ),
    declare_switch("respawn", "Start a node again after it has ended unexpectedly.", "true"),
    declare_switch("contacts", "Publish position, size and force of contacts on `contacts`."),
    declare_switch("markers", "Publish a picture of the skin (MarkerArray) on `markers`."),
    declare_switch("state_publisher", "Publish the frames of the cubes (robot_state_publisher)."),
    declare_switch(
        "record",
        "Record the skin with ros2 bag (mcap) into a new folder in the current directory.",
    ),
    declare_switch(
        "rviz", "Show the skin in RViz. This also starts markers and robot_state_publisher."
    ),
)
"""Arguments of this launch file, which `ros2 launch --show-args` lists."""


def generate_launch_description() -> LaunchDescription:
    autostart = ParameterFile(GivenParameters("autostart"))
    skin = ParameterFile(
        GivenParameters(
            *("autostart", "config", "port", "rate", "publish_period", "frame_prefix", "forces"),
            "port_directory",
        )
    )
    is_composed = LaunchConfiguration("composed")
    return LaunchDescription(
        [
            *ARGUMENTS,
            OpaqueFunction(
                function=check_arguments, args=[[argument.name for argument in ARGUMENTS]]
            ),
            make_simulator(),
            make_node("reconstruction", skin, UnlessCondition(is_composed)),
            make_node("driver", skin, UnlessCondition(is_composed)),
            make_node("composed", skin, IfCondition(is_composed)),
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
    """Return the condition that at least one of these launch arguments is true.

    Args:
        argument: Name of a launch argument.
        other: Name of a second launch argument; None: there is only one.
    """
    first, second = LaunchConfiguration(argument), LaunchConfiguration(other or argument)
    return IfCondition(OrSubstitution(first, second))


def make_node(executable: str, parameters: Any, condition: Any) -> Node:
    """Return the launch action that starts a node of this package.

    Args:
        executable: Name of the executable.
        parameters: Parameters of the node, as a file or a mapping.
        condition: Condition under which the node starts.
    """
    # The executable `composed` contains two nodes. If the launch action had a name, both of them
    # would get it.
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
        on_exit=stay_ended,
    )


def make_state_publisher() -> Node:
    """Return the action that starts a robot_state_publisher for the frames of the cubes.

    Its node and its topic have names of their own, because the robot's own robot_state_publisher
    may run in the same namespace.
    """
    urdf = ParameterValue(FromSkin(skin_urdf), value_type=str)
    return Node(
        package="robot_state_publisher",
        executable="robot_state_publisher",
        name="skin_state_publisher",
        remappings=[("robot_description", "skin_description")],
        namespace=LaunchConfiguration("namespace"),
        parameters=[{"robot_description": urdf}],
        output="screen",
        condition=if_any("state_publisher", "rviz"),
    )


def make_simulator() -> ExecuteProcess:
    """Return the launch action that starts the simulator of the hubs, which is not a ROS node."""
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
