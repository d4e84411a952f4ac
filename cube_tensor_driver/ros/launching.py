"""The processes of a skin as launch actions. Imports launch, which every ROS 2 machine has and the wheels lack."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from launch import LaunchContext, LaunchDescriptionEntity
from launch.actions import ExecuteProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from ..core.errors import ConfigError
from ..files.skin import read_skin
from .start import Process, skin_processes


def start_skin(
    context: LaunchContext,
    config: LaunchConfiguration,
    namespace: LaunchConfiguration,
    port: LaunchConfiguration | None = None,
    rate: LaunchConfiguration | None = None,
    simulate: LaunchConfiguration | None = None,
) -> list[LaunchDescriptionEntity]:
    """For an OpaqueFunction: what `skin_processes` says, as actions. ConfigError: the skin file is wrong."""

    def value(argument: LaunchConfiguration | None) -> str:
        return "" if argument is None else str(argument.perform(context))

    path = Path(value(config)).expanduser().resolve()
    read_skin(path)
    try:
        samples_per_second = float(value(rate) or 0)
    except ValueError:
        raise ConfigError(f"rate:={value(rate)}: must be a number of samples per second") from None
    ports = Path(tempfile.mkdtemp(prefix="cube_ports_")) if value(simulate) == "true" else None
    processes = skin_processes(path, port=value(port), rate=samples_per_second, simulated_ports=ports)
    return [_action(process, value(namespace)) for process in processes]


def _action(process: Process, namespace: str) -> LaunchDescriptionEntity:
    if process.node:
        return Node(
            package="cube_tensor_driver",
            executable=process.executable,
            name=process.executable,
            namespace=namespace,
            parameters=[process.parameters],
            output="screen",
            emulate_tty=True,
        )
    return ExecuteProcess(
        cmd=[sys.executable, "-m", process.module, *process.arguments], name=process.executable, output="screen"
    )
