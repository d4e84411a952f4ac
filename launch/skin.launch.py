# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Starts all cubes of a skin file, on real or simulated hubs.

It starts the nodes `driver` and `reconstruction`. Arguments of the launch file add the nodes
`contacts` and `markers`, RViz, the frames of the cubes and a recording.
"""

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import ExecuteProcess, OpaqueFunction
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import ExecutableInPackage

from cube_tensor_driver.config.output_files import make_temporary_folder
from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.config.urdf import make_skin_urdf
from cube_tensor_driver.processes.skin_processes import Process, SimulatedHubs, list_skin_processes
from cube_tensor_driver.ros.launching import (
    DEMO_LOAD,
    SkinArguments,
    check_arguments,
    declare_switch,
    declare_text,
    prevent_restart,
    record_skin,
    write_parameter_file,
    write_rviz_file,
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
    declare_text(
        "imperfections",
        "Path of a file (YAML) with deviations of simulated pads from their calibrations, among "
        "them weight in a moving skin. With its key poses, an IMU is simulated, too.",
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
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=start_skin)])


def start_skin(context: LaunchContext) -> list[Action]:
    """Check the launch arguments, and return the actions that start what they ask for."""
    given = check_arguments(context, [argument.name for argument in ARGUMENTS])
    namespace = given.texts["namespace"]
    wanted = given.switched_on
    simulated = None
    if "simulate" in wanted:
        # Each launch makes a new folder for the pseudo-terminals of its simulated hubs, so that two
        # simulated skins on one host do not use the same paths.
        ports = make_temporary_folder("cube_ports_")
        simulated = SimulatedHubs(
            ports,
            given.load,
            noise=None,
            imperfections=given.imperfections,
        )
    processes = list_skin_processes(
        given.config,
        composed="composed" in wanted,
        markers=bool(wanted & {"markers", "rviz"}),
        contacts="contacts" in wanted,
        simulated=simulated,
        **given.parameters,
    )
    actions = [make_action(process, given) for process in processes]
    if "record" in wanted:
        actions.append(record_skin(context, namespace, given.skin.name))
    if wanted & {"state_publisher", "rviz"}:
        actions.append(make_state_publisher(given.skin, namespace))
    if "rviz" in wanted:
        actions.append(
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=namespace,
                arguments=["-d", write_rviz_file(given.skin)],
            )
        )
    return actions


def make_action(process: Process, given: SkinArguments) -> Action:
    """Return the launch action that starts a process of this package.

    Args:
        process: A node, or the simulator of the hubs.
        given: The launch arguments.
    """
    name = process.executable
    if not process.node:
        command = [ExecutableInPackage(name, PACKAGE), *process.arguments]
        return ExecuteProcess(cmd=command, name=name, output="screen")
    parameters = dict(process.parameters)
    if "autostart" in given.parameters:
        parameters["autostart"] = given.parameters["autostart"]
    return Node(
        package=PACKAGE,
        executable=name,
        # The executable `composed` contains two nodes. If the launch action had a name, both of
        # them would get it.
        name=None if name == "composed" else name,
        namespace=given.texts["namespace"],
        parameters=[write_parameter_file(parameters)],
        output="screen",
        emulate_tty=True,
        respawn="respawn" in given.switched_on,
        respawn_delay=RESPAWN_DELAY_S,
        on_exit=prevent_restart,
    )


def make_state_publisher(skin: Skin, namespace: str) -> Node:
    """Return the action that starts a robot_state_publisher for the frames of the cubes.

    Its node and its topic have names of their own, because the robot's own robot_state_publisher
    may run in the same namespace.
    """
    urdf = ParameterValue(make_skin_urdf(skin), value_type=str)
    return Node(
        package="robot_state_publisher",
        executable="robot_state_publisher",
        name="skin_state_publisher",
        remappings=[("robot_description", "skin_description")],
        namespace=namespace,
        parameters=[{"robot_description": urdf}],
        output="screen",
    )
