"""What the launch files need beside the actions of launch: arguments that are checked, and texts
that are made from the skin file.

Imports launch, which every ROS 2 installation has. The ROS 2 wheels lack it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch import Action, LaunchContext, Substitution
from launch.actions import DeclareLaunchArgument, ExecuteProcess, SetLaunchConfiguration
from launch.substitutions import LaunchConfiguration
from launch_ros.utilities.namespace_utils import make_namespace_absolute, prefix_namespace

from ..config.load_script import read_script
from ..config.output_files import temporary_folder
from ..config.package_data import package_data
from ..config.parameters import DRIVER
from ..config.port import port_problem
from ..config.rviz import rviz_view
from ..config.skin import Skin, read_skin
from ..config.yaml import read_yaml, write_yaml
from ..core.errors import ConfigError

_CONFIG = package_data() / "config"
SINGLE, DEMO, DEMO_LOAD = (
    _CONFIG / name for name in ("cube.yaml", "skin_demo.yaml", "load_demo.yaml")
)
SKIN_LAUNCH = package_data() / "launch" / "skin.launch.py"
RECORD_QOS = _CONFIG / "record_qos.yaml"
NEEDS = {
    "rviz": ("rviz2", "robot_state_publisher"),
    "state_publisher": ("robot_state_publisher",),
    "record": ("ros2bag", "rosbag2_storage_mcap"),
}
"""The ROS packages beyond our own that an argument needs."""


def text(name: str, description: str, default: str = "") -> DeclareLaunchArgument:
    """A launch argument."""
    return DeclareLaunchArgument(name, default_value=default, description=description)


def switch(name: str, description: str, default: str = "false") -> DeclareLaunchArgument:
    """A launch argument that is true or false, or empty if that is the default."""
    choices = ["true", "false"] if default else ["", "true", "false"]
    return DeclareLaunchArgument(
        name, default_value=default, choices=choices, description=description
    )


class FromSkin(Substitution):  # type: ignore[misc]
    """A text that is made from the skin file of the launch argument `config`."""

    def __init__(self, make: Callable[[Skin], str]) -> None:
        super().__init__()
        self._make = make

    def describe(self) -> str:
        return f"{self._make.__name__} of config"

    def perform(self, context: LaunchContext) -> str:
        """ConfigError: the skin file is wrong."""
        return self._make(read_skin(Path(_given(context, "config"))))


class GivenParameters(Substitution):  # type: ignore[misc]
    """The path of a parameter file with the launch arguments of these names that are not empty.

    The others are left to the including launch file: what a node is passed beats its SetParameter.
    ConfigError: one is not of the parameter's type.
    """

    def __init__(self, *names: str) -> None:
        super().__init__()
        self._parameters = [parameter for parameter in DRIVER if parameter.name in names]

    def describe(self) -> str:
        return f"parameters {', '.join(parameter.name for parameter in self._parameters)}"

    def perform(self, context: LaunchContext) -> str:
        given = {
            parameter.name: _typed(parameter.name, text, type(parameter.default))
            for parameter in self._parameters
            if (text := _given(context, parameter.name))
        }
        path = temporary_folder("cube_parameters_") / "given.yaml"
        write_yaml(path, {"/**": {"ros__parameters": given}})
        return str(path)


def parent_frame(skin: Skin) -> str:
    return skin.parent_frame


def rviz_file(skin: Skin) -> str:
    """The path of a configuration of RViz for this skin."""
    path = temporary_folder("cube_rviz_") / "skin.rviz"
    write_yaml(path, rviz_view(skin))
    return str(path)


def record_skin(context: LaunchContext) -> list[Action]:
    """Start `ros2 bag record` for the skin's topics, as its nodes name them.

    A namespace, remaps and the parameter `qos_reliability` that the including launch file sets
    around the skin are applied here, because `ros2 bag` is no action of launch_ros.
    """
    surroundings: dict[str, Any] = context.launch_configurations
    namespace = make_namespace_absolute(
        prefix_namespace(surroundings.get("ros_namespace", ""), _given(context, "namespace"))
    )
    remaps: dict[str, str] = dict(surroundings.get("ros_remaps") or [])
    given = [pair for pair in surroundings.get("global_params", []) if isinstance(pair, tuple)]
    parameters: dict[str, str] = dict(given)
    reliability = parameters.get("qos_reliability", "reliable")

    qualities = {}
    for topic, quality in read_yaml(RECORD_QOS).items():
        name = topic if topic == "/diagnostics" else topic.removeprefix("/")
        name = remaps.get(name, name)
        full_name = name if name.startswith("/") else f"{(namespace or '').rstrip('/')}/{name}"
        is_batch = topic in ("/frequencies", "/stress")
        qualities[full_name] = quality | ({"reliability": reliability} if is_batch else {})
    overrides = temporary_folder("cube_record_") / "qos.yaml"
    write_yaml(overrides, qualities)

    skin = read_skin(Path(_given(context, "config")))
    parts = [
        *(namespace or "").strip("/").split("/"),
        skin.name,
        f"{datetime.now():%Y_%m_%d-%H_%M_%S}",
    ]
    folder = Path("_".join(part for part in parts if part)).absolute()
    command = ["ros2", "bag", "record", "--storage", "mcap", "--output", str(folder)]
    command += ["--qos-profile-overrides-path", str(overrides)]
    # The option --topics does not exist in Humble, --regex does everywhere.
    command += ["--regex", f"^({'|'.join(qualities)})$"]
    return [ExecuteProcess(cmd=command, name="recorder", output="screen")]


def check_arguments(context: LaunchContext) -> list[Action]:
    """The first action of a launch file: an argument that cannot work ends the launch before
    anything starts.

    It sets `config` to the path of the skin file, and `port_directory` to a new folder if hubs are
    simulated. ConfigError: an argument, the skin file or the load script is wrong, or a ROS package
    that is asked for is not installed.
    """
    simulate = _given(context, "simulate") == "true"
    config = _given(context, "config") or (str(DEMO) if simulate else "")
    if not config:
        raise ConfigError(
            "config is missing: name a skin file, config:=skin.yaml, or try simulate:=true"
        )
    path = Path(config).expanduser().resolve()
    read_skin(path)
    read_script(Path(_given(context, "load")).expanduser())
    problem = _given(context, "port") and port_problem(_given(context, "port"))
    if problem:
        raise ConfigError(f"port: {problem}")
    for name in ("rate", "publish_period"):
        _typed(name, _given(context, name) or "0", float)
    for name, packages in NEEDS.items():
        if _given(context, name) == "true":
            _check_installed(name, packages)
    ports = str(temporary_folder("cube_ports_")) if simulate else ""
    return [
        SetLaunchConfiguration("config", str(path)),
        SetLaunchConfiguration("port_directory", ports),
    ]


def _given(context: LaunchContext, name: str) -> str:
    return str(LaunchConfiguration(name).perform(context))


def _typed(name: str, text: str, kind: type) -> Any:
    if kind is bool:
        return text == "true"
    try:
        return kind(text)
    except ValueError:
        raise ConfigError(f"{name}:={text}: must be a number") from None


def _check_installed(name: str, packages: tuple[str, ...]) -> None:
    for package in packages:
        try:
            get_package_prefix(package)
        except PackageNotFoundError:
            distro = os.environ.get("ROS_DISTRO", "$ROS_DISTRO")
            raise ConfigError(
                f"{name}:=true needs the ROS package {package}: "
                f"sudo apt install ros-{distro}-{package.replace('_', '-')}"
            ) from None
