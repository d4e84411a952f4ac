"""`./cube demo`: start simulated hubs, driver and reconstruction, and watch what they publish.

The processes need most of a second for their own imports. They are therefore started before this
process imports numpy, ROS and the display; so only light modules may be imported at the top of
this file.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

from ..config.grid import grid
from ..config.package_data import package_data
from ..config.yaml import read_yaml, write_yaml
from ..core.errors import ConfigError
from ..processes.children import Children
from ..processes.skin_processes import Process, SimulatedHubs, skin_processes
from ..processes.stop_signals import stop_event

MAX_CUBES = 4096
"""Largest number of cubes of --cubes."""

PITCH = 0.012
"""Distance of neighbouring cubes of --cubes, in metres."""

DEFAULT_RATE = 100.0
"""Samples per second where neither the options nor the skin file state a rate."""

CUBES_PER_HUB = 8
"""Number of cubes on each simulated hub of --cubes."""

VIEW = Process("view", "cube_tensor_driver.cli", node=False, arguments=("view",))
"""The process of the browser view."""

INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 plus the number of SIGINT, as shells count."""


@dataclass(frozen=True)
class DemoSettings:
    """What a demo simulates, shows and writes.

    Attributes:
        config: Skin file; None: the shipped one, or a grid of `cubes` cubes.
        cubes: Number of cubes of a grid; None: no grid.
        load: Load script; None: the shipped one.
        mujoco: MuJoCo scene that takes the place of a load script. Without `config` it names its
            skin file itself.
        rate: Samples per second; None: as the skin file states, else `DEFAULT_RATE`.
        noise: Noise of the pads relative to their frequencies; None: as the calibrations state.
        imperfections: File with further faults of the pads; None: no faults.
        duration: Time to measure, in seconds, after which figures are given; None: run until
            Ctrl-C, without figures.
        headless: Whether to show no live table.
        view: Whether to show the skin in the browser, too.
        json: File for the figures; None: they are printed.
        figure: Picture of force and centre of pressure beside those of the load; None: no picture.
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
    """Run a simulated skin and show it.

    Returns:
        The exit code: 0, or `INTERRUPTED` if a measurement was interrupted.

    Raises:
        CubeError: A file or option cannot be used, a process does not start, or another skin
            publishes in this DDS domain.
    """
    # From here on Ctrl-C ends the loop that watches, and the processes end in order.
    interrupted = stop_event()
    with tempfile.TemporaryDirectory(prefix="cube_demo_") as name:
        folder = Path(name)
        skin_file = choose_skin_file(settings, folder)
        # A hub that is told no rate by anybody sends no samples.
        rate = settings.rate or rate_of_file(skin_file) or DEFAULT_RATE
        hubs = SimulatedHubs(
            folder / "ports",
            load=settings.load,
            mujoco=settings.mujoco,
            sample_log=folder / "log.json",
            noise=settings.noise,
            imperfections=settings.imperfections,
        )
        processes = skin_processes(skin_file, rate=rate, simulated=hubs)
        if settings.view:
            processes.append(VIEW)
        with Children(folder) as children:
            for process in processes:
                children.start(process)

            from .watching import Interrupted, watch

            try:
                measurement = watch(
                    settings, skin_file, rate, children, interrupted, folder / "log.json"
                )
            except Interrupted:
                # Without a duration, Ctrl-C is how a demo ends.
                return 0 if settings.duration is None else INTERRUPTED
    measurement.publish(settings)
    return 0


def choose_skin_file(settings: DemoSettings, folder: Path) -> Path:
    """Return the skin file to simulate; the file of a grid is written into `folder`.

    Raises:
        ConfigError: The options contradict each other.
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
        from ..simulation.mujoco.scene import scene_skin

        return scene_skin(settings.mujoco)
    if settings.cubes is not None:
        return write_grid(folder / "skin.yaml", settings.cubes, settings.rate or DEFAULT_RATE)
    return package_data() / "config" / "skin_demo.yaml"


def write_grid(path: Path, cubes: int, rate: float) -> Path:
    """Write the skin file of a grid that is as nearly square as possible, and return its path.

    Raises:
        ConfigError: There are too many cubes.
    """
    if not 1 <= cubes <= MAX_CUBES:
        raise ConfigError(f"--cubes is {cubes}, allowed: 1 to {MAX_CUBES}")
    nx = math.ceil(math.sqrt(cubes))
    ny = math.ceil(cubes / nx)
    links = math.ceil(cubes / CUBES_PER_HUB)
    skin = grid(
        nx=nx,
        ny=ny,
        pitch=PITCH,
        links=links,
        rate=rate,
    )
    # The last row may be incomplete; a hub that loses all of its cubes goes as well.
    skin["cubes"] = skin["cubes"][:cubes]
    used = {cube["link"] for cube in skin["cubes"]}
    skin["links"] = [link for link in skin["links"] if link["name"] in used]
    write_yaml(path, skin)
    return path


def rate_of_file(skin_file: Path) -> float | None:
    """Return the rate that a skin file states, None if it states no usable one.

    The file is not checked here, because that needs numpy: `watch` does so.
    """
    content = read_yaml(skin_file)
    rate = content.get("rate") if isinstance(content, dict) else None
    return float(rate) if isinstance(rate, (int, float)) else None
