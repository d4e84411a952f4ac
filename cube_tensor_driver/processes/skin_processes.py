"""What to start for a skin: the list of `./cube demo`. launch/skin.launch.py has the same processes
as actions."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

Value = str | float | bool
RECORDED = ("frequencies", "stress", "info", "driver/info", "/diagnostics")
"""The topics of a recording. `frequencies` and `info` are enough to reconstruct everything again,
`driver/info` where no reconstruction runs; `stress` is what was published at the time,
`/diagnostics` what the nodes said about links and cubes."""


@dataclass(frozen=True)
class Process:
    """One process of a running skin.

    executable: its name in the package. module: what `python -m` runs. node: whether it is a ROS
    node, which takes parameters; other processes take arguments. program: path of what runs in the
    place of a module.
    """

    executable: str
    module: str
    node: bool = True
    parameters: dict[str, Value] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    program: str = ""


@dataclass(frozen=True)
class SimulatedHubs:
    """The simulator that takes the place of the real hubs.

    ports: folder for its pseudo-terminals. load: its load script; None: the one in the package.
    mujoco: a MuJoCo scene instead of a load script.
    sample_log: file for a record of every sample it sends; None: none. instants: how many instants
    of the load it computes in advance, see `simulation.simulator.Simulator`; None: its default.
    noise: of the pads, relative to their frequencies; None: as the calibrations state.
    imperfections: file of what else is wrong with the pads; None: nothing.
    """

    ports: Path
    load: Path | None = None
    mujoco: Path | None = None
    sample_log: Path | None = None
    instants: int | None = None
    noise: float | None = 0.0
    imperfections: Path | None = None

    def process(self, config: Path) -> Process:
        """The simulator of the skin file `config`."""
        arguments = ["--config", str(config), "--ports", str(self.ports)]
        if self.load is not None:
            arguments += ["--load", str(self.load)]
        if self.mujoco is not None:
            arguments += ["--mujoco", str(self.mujoco)]
        if self.sample_log is not None:
            arguments += ["--log", str(self.sample_log)]
        if self.instants is not None:
            arguments += ["--instants", str(self.instants)]
        if self.noise is not None:
            arguments += ["--noise", str(self.noise)]
        if self.imperfections is not None:
            arguments += ["--imperfections", str(self.imperfections)]
        module = "cube_tensor_driver.simulation.main"
        return Process("simulator", module, node=False, arguments=tuple(arguments))


def skin_processes(
    config: Path,
    *,
    port: str = "",
    rate: float = 0.0,
    publish_period: float = 0.0,
    composed: bool = False,
    markers: bool = False,
    contacts: bool = False,
    simulated: SimulatedHubs | None = None,
) -> list[Process]:
    """The processes of a skin file, in the order in which they start.

    These are the driver and the reconstruction, or one process with both if `composed`; before them
    the simulator, if hubs are `simulated`; after them the nodes `markers` and `contacts` if wanted.

    port: replaces the port in the file, for a skin with one link. rate: samples per second, 0: as
    the file says. publish_period: time that one message covers, s, 0: one message per scan.
    """
    common: dict[str, Value] = {"config": str(config), "publish_period": publish_period}
    port_directory = str(simulated.ports) if simulated else ""
    driver = {**common, "port": port, "rate": rate, "port_directory": port_directory}

    processes = [simulated.process(config)] if simulated else []
    if composed:
        processes.append(_node("composed", driver))
    else:
        processes += [_node("reconstruction", common), _node("driver", driver)]
    if markers:
        processes.append(_node("markers", {}))
    if contacts:
        processes.append(_node("contacts", {}))
    return processes


def _node(name: str, parameters: dict[str, Value]) -> Process:
    return Process(name, f"cube_tensor_driver.ros.nodes.{name}", parameters=dict(parameters))
