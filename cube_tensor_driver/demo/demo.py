# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""`./cube demo`: start simulated hubs, driver and reconstruction, and watch what they publish.

The processes need almost a second for their own imports. They are therefore started before this
process imports numpy, ROS and the live table, and the top of this file may only import modules that
import none of these.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

from ..config.grid import describe_grid
from ..config.package_data import find_package_data
from ..config.yaml import read_yaml, write_yaml
from ..core.errors import ConfigError
from ..processes.children import Children
from ..processes.domain import is_domain_used
from ..processes.skin_processes import VIEW, SimulatedHubs, list_skin_processes
from ..processes.stop_signals import INTERRUPTED, stop_event

MAX_CUBES = 4096
"""Maximum number of cubes of a grid that `./cube demo --cubes N` simulates."""

DEFAULT_RATE = 100.0
"""Samples per second of each cube, if neither the option --rate nor the skin file states a rate."""

CUBES_PER_HUB = 8
"""Number of cubes on each simulated hub of the grid that `./cube demo --cubes N` simulates."""


@dataclass(frozen=True, kw_only=True)
class DemoSettings:
    """What a demo simulates, shows and writes.

    Attributes:
        config: Skin file to simulate; None: the shipped one, or a grid if `cubes` is set.
        cubes: Number of cubes of a grid to simulate; None: no grid.
        load: File with the forces that act on the skin over time; None: the shipped one.
        mujoco: MuJoCo scene whose bodies touch the skin, instead of `load`. If `config` is None,
            the scene names the skin file.
        rate: Samples per second of each cube; None: that of the skin file, else `DEFAULT_RATE`.
        noise: Standard deviation of the pads' frequencies, relative to the frequencies; None: as
            the calibrations state.
        imperfections: File that states how pads differ from their calibrations: spread of gains
            and of heights of the layer, dead pads, creep, temperature, and weight in a moving skin;
            None: not at all.
        duration: Time to measure, in seconds, after which the results are printed; None: the demo
            runs until Ctrl-C and prints no results.
        headless: Whether the live table is not shown.
        view: Whether to show the skin in the browser, too.
        json: File for the results as JSON; None: they are printed.
        figure: File for a picture of the applied and the measured force and centre of pressure
            over time; None: no picture.
    """

    config: Path | None = None
    cubes: int | None = None
    load: Path | None = None
    mujoco: Path | None = None
    rate: float | None = None
    noise: float | None = None
    imperfections: Path | None = None
    duration: float | None = None
    headless: bool = False
    view: bool = False
    json: Path | None = None
    figure: Path | None = None


def run_demo(settings: DemoSettings) -> int:
    """Simulate a skin, run the nodes driver and reconstruction, and show or measure their tensors.

    Returns:
        The exit code: 0, or `INTERRUPTED` if Ctrl-C ended a measurement before its duration.

    Raises:
        CubeError: A file or option cannot be used, a process does not start, or another skin
            publishes in this DDS domain.
    """
    # From here on, Ctrl-C only sets this event, which ends the loop in `watch`. Then `Children`
    # ends all processes.
    interrupted = stop_event()
    if is_domain_used():
        from .watching import check_no_skin

        check_no_skin()
    with tempfile.TemporaryDirectory(prefix="cube_demo_") as name:
        folder = Path(name)
        skin_file = choose_skin_file(settings, folder)
        # A hub to which the driver sends no rate takes no samples.
        rate = settings.rate or read_rate(skin_file) or DEFAULT_RATE
        hubs = SimulatedHubs(
            folder / "ports",
            load=settings.load,
            mujoco=settings.mujoco,
            sample_log=folder / "log.json",
            noise=settings.noise,
            imperfections=settings.imperfections,
        )
        processes = list_skin_processes(skin_file, rate=rate, simulated=hubs)
        if settings.view:
            processes.append(VIEW)
        with Children(folder) as children:
            for process in processes:
                children.start(process)

            from .watching import Interrupted, watch

            try:
                measurement = watch(
                    settings,
                    skin_file,
                    rate,
                    children,
                    interrupted,
                    folder / "log.json",
                )
            except Interrupted:
                # Without a duration, Ctrl-C is the normal end of a demo.
                return 0 if settings.duration is None else INTERRUPTED
    measurement.publish(settings)
    return 0


def choose_skin_file(settings: DemoSettings, folder: Path) -> Path:
    """Return the path of the skin file to simulate.

    Args:
        settings: The settings of the demo.
        folder: Folder into which the skin file of a grid (`settings.cubes`) is written.

    Raises:
        ConfigError: The settings contradict each other.
    """
    if settings.mujoco is not None and settings.load is not None:
        raise ConfigError("--load and --mujoco are two loads for one skin; give one of them")
    if settings.config is not None:
        return settings.config.resolve()
    if settings.mujoco is not None:
        if settings.cubes is not None:
            raise ConfigError(
                "--cubes makes a skin that no scene knows; name its file with --config"
            )
        from ..simulation.mujoco.scene import find_scene_skin

        return find_scene_skin(settings.mujoco)
    if settings.cubes is not None:
        rate = settings.rate or DEFAULT_RATE
        return write_grid(folder / "skin.yaml", settings.cubes, rate)
    return find_package_data() / "config" / "skin_demo.yaml"


def write_grid(
    path: Path,
    cubes: int,
    rate: float,
    cubes_per_hub: int = CUBES_PER_HUB,
) -> Path:
    """Write the skin file of a grid that is as nearly square as possible, and return its path.

    Args:
        path: The file to write.
        cubes: Number of cubes; the last row of the grid may be incomplete.
        rate: Samples per second of each cube.
        cubes_per_hub: Maximum number of cubes on each hub.

    Raises:
        ConfigError: The number of cubes is not from 1 to `MAX_CUBES`.
    """
    if not 1 <= cubes <= MAX_CUBES:
        raise ConfigError(f"--cubes is {cubes}, allowed: 1 to {MAX_CUBES}")
    nx = math.ceil(math.sqrt(cubes))
    ny = math.ceil(cubes / nx)
    links = math.ceil(cubes / cubes_per_hub)
    skin = describe_grid(nx=nx, ny=ny, links=links, rate=rate)
    # Surplus cubes of the last row are removed, and with them links (hubs) without any cube.
    skin["cubes"] = skin["cubes"][:cubes]
    used = {cube["link"] for cube in skin["cubes"]}
    all_links = skin["links"]
    skin["links"] = [link for link in all_links if link["name"] in used]
    write_yaml(path, skin)
    return path


def read_rate(skin_file: Path) -> float | None:
    """Return the samples per second that a skin file states; None if it states no number.

    The file is not checked here, because the check needs numpy; `watch` checks it later.
    """
    content = read_yaml(skin_file)
    if not isinstance(content, dict):
        return None
    rate = content.get("rate")
    return float(rate) if isinstance(rate, (int, float)) else None
