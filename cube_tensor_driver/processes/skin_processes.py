"""The processes that a skin needs, as `./cube demo` starts them.

launch/skin.launch.py has the same processes as actions.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

Value = str | float | bool
"""Value of a parameter."""

RECORDED = ("frequencies", "stress", "info", "driver/info", "/diagnostics")
"""The topics of a recording.

`frequencies` and `info` are enough to reconstruct everything again, `driver/info` where no
reconstruction runs; `stress` is what was published at the time, `/diagnostics` what the nodes
reported about links and cubes.
"""


@dataclass(frozen=True)
class Process:
    """One process of a running skin.

    Attributes:
        executable: Its name in the package.
        module: The module that `python -m` runs.
        node: Whether it is a ROS node, which takes parameters. Other processes take arguments.
        parameters: Name of a parameter -> its value.
        arguments: Arguments of the command line.
        program: Path of a program that runs in the place of the module; empty: the module.
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

    Attributes:
        ports: Folder for its pseudo-terminals.
        load: Its load script; None: the one in the package.
        mujoco: A MuJoCo scene instead of a load script; None: none.
        sample_log: File for a record of every sample that it sends; None: none.
        instants: Number of instants of the load that it computes in advance, see
            `simulation.simulator.Simulator`; None: its default.
        noise: Noise of the pads, relative to their frequencies; None: as the calibrations state.
        imperfections: File of what else is wrong with the pads; None: nothing.
    """

    ports: Path
    load: Path | None = None
    mujoco: Path | None = None
    sample_log: Path | None = None
    instants: int | None = None
    noise: float | None = 0.0
    imperfections: Path | None = None

    def process(self, config: Path) -> Process:
        """Return the simulator of the skin file `config`."""
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
        # An option that is not given leaves the simulator its default.
        given = {name: str(value) for name, value in options.items() if value is not None}
        arguments = tuple(word for option in given.items() for word in option)
        module = "cube_tensor_driver.simulation.main"
        return Process(
            "simulator",
            module,
            node=False,
            arguments=arguments,
        )


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
    """Return the processes of a skin file, in the order in which they start.

    Args:
        config: The skin file.
        port: Port instead of the one in the file, for a skin with one link.
        rate: Samples per second; 0: as the file says.
        publish_period: Time that one message covers, in s; 0: one message per scan.
        composed: Whether one process holds driver and reconstruction.
        markers: Whether the node `markers` runs, too.
        contacts: Whether the node `contacts` runs, too.
        simulated: Simulated hubs instead of real ones.
    """
    # Queue depths of both nodes follow from the publish period.
    common: dict[str, Value] = {"config": str(config), "publish_period": publish_period}
    port_directory = str(simulated.ports) if simulated else ""
    driver = {
        **common,
        "port": port,
        "rate": rate,
        "port_directory": port_directory,
    }

    # The ports of simulated hubs must exist before the driver opens them.
    processes = [simulated.process(config)] if simulated else []
    if composed:
        processes.append(_node("composed", driver))
    else:
        # The reconstruction subscribes first, so that it misses no rows of the driver.
        processes += [_node("reconstruction", common), _node("driver", driver)]
    if markers:
        processes.append(_node("markers", {}))
    if contacts:
        processes.append(_node("contacts", {}))
    return processes


def _node(name: str, parameters: dict[str, Value]) -> Process:
    return Process(name, f"cube_tensor_driver.ros.nodes.{name}", parameters=dict(parameters))
