# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The processes that a skin needs, as `./cube demo` and launch/skin.launch.py start them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

Value = str | float | bool
"""Type of the value of a ROS parameter."""

RECORDED = ("frequencies", "stress", "compensation", "info", "driver/info", "diagnostics")
"""Topics of a skin that `./cube record` records by default.

From `frequencies` and `info` the stress can be computed again; `driver/info` replaces `info` while
no reconstruction runs. `stress` is recorded to keep the published results, and `diagnostics` to
keep the reports about links and cubes.
"""


@dataclass(frozen=True)
class Process:
    """One process of a running skin.

    Attributes:
        executable: Name of the executable in the ROS package, which also names the process.
        module: Python module that runs as `python -m module`.
        node: Whether the process is a ROS node. Only nodes take `parameters`.
        parameters: Name of a ROS parameter -> its value.
        arguments: Arguments of the command line.
        program: Path of a program that is started instead of the module; empty: the module is.
    """

    executable: str
    module: str
    node: bool = True
    parameters: dict[str, Value] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    program: str = ""


VIEW = Process(
    "view",
    "cube_tensor_driver.cli",
    node=False,
    arguments=("view",),
)
"""The process `./cube view`, which shows the skin in the browser. `./cube demo --view` and
`./cube replay --view` start it."""


@dataclass(frozen=True)
class SimulatedHubs:
    """Options of the simulator, a process that replaces the real hubs of a skin.

    Attributes:
        ports: Folder in which the simulator makes a pseudo-terminal (virtual serial port) per link.
        load: Load script (YAML) that states the forces on the skin; None: the one in the package.
        mujoco: MuJoCo scene that replaces the load script; None: the load script is used.
        sample_log: File to which every sent sample is written; None: no file is written.
        instants: Number of instants of the load that are computed in advance, see
            `simulation.simulator.Simulator`; None: the default of the simulator.
        noise: Standard deviation of the frequencies of the pads, divided by the frequency; None:
            the noise that the calibrations state.
        imperfections: File (YAML) with deviations of the pads from their calibration; None: the
            pads are as the calibration states.
    """

    ports: Path
    load: Path | None = None
    mujoco: Path | None = None
    sample_log: Path | None = None
    instants: int | None = None
    noise: float | None = 0.0
    imperfections: Path | None = None

    @property
    def has_imu(self) -> bool:
        """Whether the skin moves, so that an IMU on it is simulated, too.

        Raises:
            ConfigError: The file of imperfections cannot be read.
        """
        if not self.imperfections:
            return False
        # The help of commands imports this file, and needs no YAML library.
        from ..config.yaml import read_yaml

        content = read_yaml(self.imperfections)
        return isinstance(content, dict) and bool(content.get("poses"))

    def process(self, config: Path) -> Process:
        """Return the process that simulates the hubs of the skin file `config`."""
        options = {
            "--config": config,
            "--ports": self.ports,
            "--load": self.load,
            "--mujoco": self.mujoco,
            "--log": self.sample_log,
            "--instants": self.instants,
            "--noise": self.noise,
            "--imperfections": self.imperfections,
        }
        # Options that are None are left out, so that the simulator uses its defaults.
        given = {name: str(value) for name, value in options.items() if value is not None}
        arguments = tuple(word for option in given.items() for word in option)
        module = "cube_tensor_driver.simulation.main"
        return Process(
            "simulator",
            module,
            node=False,
            arguments=arguments,
        )


def list_skin_processes(
    config: Path,
    *,
    composed: bool = False,
    markers: bool = False,
    contacts: bool = False,
    simulated: SimulatedHubs | None = None,
    **parameters: Value,
) -> list[Process]:
    """Return the processes of a skin, in the order in which they must be started.

    Args:
        config: The skin file.
        composed: Whether driver and reconstruction run in one process.
        markers: Whether the node `markers` (picture for RViz) runs, too.
        contacts: Whether the node `contacts` (contacts on the skin) runs, too.
        simulated: Options of simulated hubs; None: the hubs are real.
        parameters: Further ROS parameters of the nodes that process frequencies (driver,
            reconstruction and simulated IMU), such as `rate`. Each node takes those that it has.
    """
    given: dict[str, Value] = {"config": str(config), **parameters}
    # The ports of simulated hubs must exist before the driver opens them.
    processes = []
    if simulated is not None:
        processes.append(simulated.process(config))
        given["port_directory"] = str(simulated.ports)
        if simulated.has_imu:
            motion: dict[str, Value] = {"imperfections": str(simulated.imperfections)}
            processes.append(_make_node_process("simulated_imu", given | motion))
            given["imu"] = "imu"
    # The reconstruction starts first, so that it has subscribed before the driver publishes.
    names = ["composed"] if composed else ["reconstruction", "driver"]
    processes += [_make_node_process(name, given) for name in names]
    if markers:
        processes.append(_make_node_process("markers", {}))
    if contacts:
        processes.append(_make_node_process("contacts", {}))
    return processes


def _make_node_process(name: str, parameters: dict[str, Value]) -> Process:
    return Process(
        name,
        f"cube_tensor_driver.ros.nodes.{name}",
        parameters=dict(parameters),
    )
