"""What to start for a skin: the one list that the launch files and ./cube demo both take. Does not
import ROS."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from ..config.package_data import package_data
from ..config.yaml import read_yaml, write_yaml

Value = str | float | bool
RECORDED = ("frequencies", "stress", "info")
"""What a recording needs: `frequencies` and `info` make everything again, `stress` is what was
seen."""


@dataclass(frozen=True)
class Process:
    """One process of a running skin.

    executable: its name in the package; module: what `python -m` runs. node: whether it is a ROS
    node and takes parameters; otherwise it takes arguments.
    """

    executable: str
    module: str
    node: bool = True
    parameters: dict[str, Value] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()


def skin_processes(
    config: Path,
    *,
    port: str = "",
    rate: float = 0.0,
    publish_period: float = 0.0,
    composed: bool = False,
    autostart: bool = True,
    markers: bool = False,
    contacts: bool = False,
    simulated_ports: Path | None = None,
    book: Path | None = None,
    instants: int | None = None,
    load: Path | None = None,
) -> list[Process]:
    """Driver and reconstruction of a skin file; with a folder for simulated ports the simulator
    too.

    port: instead of the one in the file, for a skin with one link. rate: samples per second instead
    of the file's, 0 for the file's. publish_period: time that one message covers, s; 0: a message
    for each scan. composed: driver and reconstruction in one process. autostart: False leaves nodes
    to be configured and activated by lifecycle transitions. markers, contacts: those nodes, too.
    book: where the simulator writes what it sampled; instants: see `simulation.main.Simulator`;
    load: its load script, None for the shipped one.
    """
    start: dict[str, Value] = {} if autostart else {"autostart": False}
    skin: dict[str, Value] = {"config": str(config), "publish_period": publish_period, **start}
    driver: dict[str, Value] = {
        **skin,
        "port": port,
        "rate": rate,
        "port_directory": str(simulated_ports or ""),
    }
    if composed:
        processes = [Process("composed", "cube_tensor_driver.ros.composed", parameters=driver)]
    else:
        processes = [
            Process("reconstruction", "cube_tensor_driver.ros.reconstruction", parameters=skin),
            Process("driver", "cube_tensor_driver.ros.driver", parameters=driver),
        ]
    for name, wanted in {"markers": markers, "contacts": contacts}.items():
        if wanted:
            processes.append(Process(name, f"cube_tensor_driver.ros.{name}", parameters=start))
    if simulated_ports is not None:
        arguments = ["--config", str(config), "--ports", str(simulated_ports)]
        if load is not None:
            arguments += ["--load", str(load)]
        if book is not None:
            arguments += ["--book", str(book)]
        if instants is not None:
            arguments += ["--instants", str(instants)]
        processes.insert(
            0,
            Process(
                "simulator", "cube_tensor_driver.simulation.main", False, arguments=tuple(arguments)
            ),
        )
    return processes


def record_command(skin: str, namespace: str = "") -> list[str]:
    """ros2 bag record of a running skin, into a new folder where it is started:
    [namespace_]skin_date-time."""
    parts = [part for part in namespace.split("/") if part]
    prefix = "".join(f"/{part}" for part in parts)
    folder = "_".join([*parts, skin, f"{datetime.now():%Y_%m_%d-%H_%M_%S}"])
    overrides = package_data() / "config" / "record_qos.yaml"
    if prefix:
        # The file names topics without a namespace.
        profiles = {prefix + topic: profile for topic, profile in read_yaml(overrides).items()}
        overrides = Path(tempfile.mkdtemp(prefix="cube_record_")) / overrides.name
        write_yaml(overrides, profiles)
    return [
        "ros2",
        "bag",
        "record",
        "--storage",
        "mcap",
        "-o",
        folder,
        "--qos-profile-overrides-path",
        str(overrides),
        "--topics",
        *(f"{prefix}/{topic}" for topic in RECORDED),
    ]
