# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes, as tables of plain data.

The nodes declare these ROS parameters, commands that run without ROS take some of them as options,
and docs/parameters.md lists them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import NamedTuple, cast

from ..core.defaults import CONTACT_METHODS, CONTACT_PRESSURE
from ..core.modes import STRESS
from .influence import find_influence_problem
from .port import find_port_problem

QUANTITIES = ("pressure", "shear", "gradient", *STRESS, "residual")
"""Names of the quantities that the colours of the cubes can show in RViz and Foxglove."""

ParameterValue = bool | float | str
"""Value of a ROS parameter of the nodes."""


def find_hardware_problem(name: str) -> str:
    """Return an error message for the name of a ros2_control hardware component, "" if it is valid.

    Names of topics contain this name, with each "/" replaced by "_".
    """
    if re.fullmatch("[A-Za-z_][A-Za-z0-9_/]*", name):
        return ""
    return f"found {name!r}, allowed: letters, digits, _ and /, with no digit first"


class Parameter(NamedTuple):
    """Declaration of a ROS parameter of a node.

    Attributes:
        name: Name of the parameter.
        default: Default value; its Python type is the type of the parameter.
        description: Text that `ros2 param describe` shows.
        span: Smallest and largest allowed value of a number, both included; None: no limits.
        choices: Allowed values of a text, separated by ", "; empty: any text.
        live: Whether the value may change while the node is configured.
        minimum: Smallest allowed value of a number for which 0 is also allowed, with a special
            meaning such as "off"; None: 0 has no special meaning.
        problem: Function that takes the value of a text and returns an error message, or "" if the
            value is valid. It is not called for an empty text.
    """

    name: str
    default: ParameterValue
    description: str
    span: tuple[float, float] | None = None
    choices: str = ""
    live: bool = False
    minimum: float | None = None
    problem: Callable[[str], str] | None = None

    def parse(self, text: str) -> ParameterValue:
        """Convert a text into a value of the parameter's type: bool, float or str.

        If the parameter is a number but the text is not, the result is NaN, which `find_refusal`
        reports.
        """
        if isinstance(self.default, bool):
            return text.lower() == "true"
        if not isinstance(self.default, float):
            return text
        try:
            return float(text)
        except ValueError:
            return math.nan

    def find_refusal(self, value: ParameterValue) -> str:
        """Return an error message if the parameter does not allow a value; "" if it does.

        Args:
            value: The value, which has the type of the parameter.
        """
        found = f"parameter {self.name} is {value!r}"
        if self.choices and value not in self.choices.split(", "):
            return f"{found}, allowed: {self.choices}"
        if self.span is not None:
            low, high = self.span
            number = cast("float", value)  # only numbers have a span
            is_zero = self.minimum is not None and number == 0
            # The comparison is false for NaN, so that NaN is refused, too.
            if not (is_zero or (self.minimum or low) <= number <= high):
                allowed = f"{low:g} to {high:g}"
                if self.minimum:
                    allowed = f"0, or {self.minimum:g} to {high:g}"
                return f"{found}, allowed: {allowed}"
        if self.problem is None or not value:
            return ""
        text = cast("str", value)  # only texts have such a function
        problem = self.problem(text)
        return f"parameter {self.name}: {problem}" if problem else ""


AUTOSTART = Parameter(
    "autostart",
    True,
    "With true the node configures and activates itself when it starts. With false it waits for "
    "lifecycle transitions.",
)
"""Declaration of the ROS parameter `autostart`, which every node of this package has."""

RELIABILITY = Parameter(
    "qos_reliability",
    "reliable",
    "Reliability (quality of service) of the topics `frequencies`, `stress` and `forces`.",
    choices="reliable, best_effort",
)
"""Declaration of the ROS parameter `qos_reliability` of the nodes `driver` and `reconstruction`."""

FRAME_PREFIX = Parameter(
    "frame_prefix",
    "",
    "Text in front of the frame ids of the skin and its cubes, such as left_ for one of two skins "
    "with the same skin file.",
)
"""Declaration of the ROS parameter `frame_prefix` of all nodes that read a skin file."""

CONFIG = Parameter(
    "config",
    "",
    "Path of the skin file (YAML). It is required.",
)
"""Declaration of the ROS parameter `config` of the nodes `driver` and `simulated_imu`."""

DRIVER = (
    AUTOSTART,
    CONFIG,
    FRAME_PREFIX,
    Parameter(
        "port",
        "",
        "Port that replaces the one in the skin file, which must have a single link. An empty text "
        "keeps the ports of the skin file.",
        problem=find_port_problem,
    ),
    Parameter(
        "port_directory",
        "",
        "Folder in which simulated hubs make their ports, each under the name of its link. These "
        "ports replace those in the skin file. An empty text keeps the ports of the skin file.",
    ),
    Parameter(
        "rate",
        0.0,
        "Sampling rate of each cube, in Hz, that the driver asks of the hubs. With 0 it is the "
        "rate in the skin file.",
        span=(0.0, 10_000.0),
        live=True,
        minimum=0.1,
    ),
    Parameter(
        "publish_period",
        0.0,
        "Time, in s, whose scans are sent together in one message. With 0 every scan is a message "
        "of its own. A scan is one sample of every cube.",
        span=(0.0, 1.0),
    ),
    RELIABILITY,
)
"""Declarations of the ROS parameters of the node `driver`, which reads the hubs."""

RECONSTRUCTION = (
    AUTOSTART,
    Parameter(
        "config",
        "",
        "Path of the skin file (YAML), or of a bag. From the bag the node takes the skin, the "
        "tares and the drift of the recording, so that replayed frequencies give the recorded "
        "stress. It is required.",
    ),
    FRAME_PREFIX,
    Parameter(
        "wrench_side",
        0.0,
        "Side, in m, of the square face over which stress is integrated to wrenches and forces. "
        "With 0 it is the side of the cube itself.",
        span=(0.0, 10.0),
    ),
    Parameter(
        "forces",
        False,
        "With true the node publishes one force per cube as a point cloud on `forces`.",
    ),
    Parameter(
        "touch_false_alarms",
        1.0,
        "Rate, per hour, at which noise alone is taken for a touch somewhere on the skin. The node "
        "publishes the touches of every scan on `touch` while it has a subscriber. With 0 there is "
        "no such topic.",
        span=(0.0, 3600.0),
        minimum=1e-3,
    ),
    Parameter(
        "hardware_name",
        "",
        "Name of a hardware component of ros2_control (cm_topic_hardware_component) in the URDF of "
        "the robot. It gets the wrenches of all cubes, and of the whole skin, as state interfaces. "
        "With an empty text they are not published.",
        problem=find_hardware_problem,
    ),
    Parameter(
        "publish_period",
        0.0,
        "Value of the driver's parameter publish_period, in s. The node computes the depths of its "
        "queues and the limit for the size of a message from it.",
        span=(0.0, 1.0),
    ),
    RELIABILITY,
    Parameter(
        "tare_duration",
        1.0,
        "Time, in s, over which the service ~/tare averages frequencies if the request states no "
        "duration.",
        span=(0.5, 10.0),
        live=True,
    ),
    Parameter(
        "tare_folder",
        "",
        "Folder in which tares are stored, one file per uid of a cube. An empty text stands for "
        "~/.ros/cube_tensor_driver/tare.",
    ),
    Parameter(
        "drift_time",
        0.0,
        "Time constant, in s, with which the rest frequencies (frequencies without load) of a cube "
        "follow slow drift while nothing touches it. With 0 they do not follow drift.",
        span=(0.0, 1e6),
        live=True,
    ),
    Parameter(
        "gravity",
        "",
        "Frame whose z axis points up. Its transform to the parent frame of the skin on /tf then "
        "gives the direction of gravity, with which the weight of cubes and elastomer is "
        "compensated. It is for arms that move slowly; an empty text stands for none.",
    ),
    Parameter(
        "imu",
        "",
        "Topic (sensor_msgs/Imu) of an IMU that is fixed to the same rigid body as the skin, with "
        "which weight and inertia of cubes and elastomer are compensated; an empty text stands for "
        "none.",
    ),
)
"""Declarations of the ROS parameters of the node `reconstruction`, which computes stress tensors
from the frequencies of pads."""

SKIN_SUBSCRIBER = (
    AUTOSTART,
    Parameter(
        "rate",
        20.0,
        "Maximum rate, in Hz, at which the node computes and publishes its messages.",
        span=(0.1, 100.0),
    ),
)
"""Declarations of the ROS parameters that the nodes `markers` and `contacts` have in common."""

MARKERS = (
    *SKIN_SUBSCRIBER,
    Parameter(
        "quantity",
        "pressure",
        "Quantity that the colours of the cubes show.",
        choices=", ".join(QUANTITIES),
    ),
    Parameter(
        "range",
        0.0,
        "Value of the quantity, in SI units, at the upper end of the colour scale. With 0 the "
        "scale adapts to the values.",
        span=(0.0, 1e9),
    ),
    Parameter(
        "crosses",
        False,
        "With true the principal stresses of each cube are drawn as three crossing lines.",
    ),
)
"""Declarations of the ROS parameters of the node `markers`, which draws the skin for RViz and
Foxglove."""

CONTACTS = (
    *SKIN_SUBSCRIBER,
    Parameter(
        "least",
        CONTACT_PRESSURE,
        "Minimum pressure, in Pa, in the plane of the cubes that counts as contact.",
        span=(0.0, 1e9),
    ),
    Parameter(
        "method",
        CONTACT_METHODS[0],
        "Method that finds contacts. The method interpolation interpolates the pressure between "
        "the cubes. The method inverse computes the traction (force per area) on the surface from "
        "the elasticity of the skin, and publishes it on `traction`, too. The default, auto, is "
        "inverse if the skin file states the `elastomer`, otherwise interpolation.",
        choices=", ".join(CONTACT_METHODS),
    ),
    Parameter(
        "influence",
        "",
        "Table of influence functions (response of each pad to a unit force at points of the "
        "surface), for the method inverse. It is the name of a table in the package, or a file "
        "made by `./cube fem MODEL --load surface`. The table then replaces the `elastomer` of the "
        "skin file. With an empty text each cube is taken as a point in a homogeneous elastomer.",
        problem=find_influence_problem,
    ),
)
"""Declarations of the ROS parameters of the node `contacts`, which computes positions and forces of
contacts."""

SIMULATED_IMU = (
    AUTOSTART,
    CONFIG,
    FRAME_PREFIX,
    Parameter("port_directory", "", "Folder in which the simulated hubs make their ports."),
    Parameter(
        "imperfections",
        "",
        "Path of the file (YAML) from which the simulated hubs take `poses`.",
    ),
)
"""Declarations of the ROS parameters of the node `simulated_imu`, which goes with simulated hubs of
a skin that moves."""
