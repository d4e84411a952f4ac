"""`./cube demo`: simulated hubs, driver and reconstruction in processes of their own, watched over
DDS. What arrives is compared with what was sent, and tensors with the load."""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray

from ..config.grid import grid
from ..config.load_script import read_script
from ..config.output_files import write_json
from ..config.package_data import package_data
from ..config.skin import Skin, read_skin
from ..config.yaml import write_yaml
from ..core.errors import ConfigError, CubeError, MessageError
from ..messages.codec import frequency_codec, stress_codec
from ..msg import SkinFrequencies, SkinStress
from ..processes.children import Children
from ..processes.skin_processes import Process, SimulatedHubs, skin_processes
from ..ros.node import queue
from ..simulation.imperfections import read_imperfections
from ..simulation.load import AnyLoad, Load, default_script
from ..simulation.mujoco.scene import MujocoLoad, scene_skin
from ..views.figures.skin_force import draw_forces
from ..views.figures.style import save
from ..views.terminal.live_table import LiveTable
from .load_verification import LoadVerification
from .running import Interrupted, Observer, Usage, end_simulator, interruption, observing

FIRST_TENSORS_S = 20.0
LAST_TENSORS_S = 2.0
MOST_CUBES = 4096
PITCH, RATE, CUBES_PER_HUB = 0.012, 100.0, 8
NODES = ("driver", "reconstruction")
VIEW = Process("view", "cube_tensor_driver.cli", node=False, arguments=("view",))


def run_demo(
    *,
    config: Path | None = None,
    cubes: int | None = None,
    load: Path | None = None,
    mujoco: Path | None = None,
    rate: float | None = None,
    noise: float | None = None,
    imperfections: Path | None = None,
    duration: float | None = None,
    headless: bool = False,
    view: bool = False,
    json_path: Path | None = None,
    figure: Path | None = None,
) -> int:
    """Run a simulated skin and show it; returns the exit code.

    config: skin file; None: the shipped one, or a grid of so many `cubes`
    load: load script; None: the shipped one
    mujoco: MuJoCo scene that takes the place of a load script; without `config` it names its skin
    rate: samples per second; None: the skin's, 100 where it has none
    noise: of the pads, relative to their frequencies; None: as the calibrations state
    imperfections: file of what else is wrong with the pads; None: nothing
    duration: s to measure, after which figures are given; None: until Ctrl-C, without figures
    headless: without the live table
    view: show it in the browser too
    json_path: file for the figures, which are printed otherwise
    figure: picture of the reconstructed force and centre of pressure beside the script's

    CubeError: something does not start, or another skin publishes here.
    """
    interrupted = interruption()
    try:
        with tempfile.TemporaryDirectory(prefix="cube_demo_") as name:
            folder = Path(name)
            path = _skin_path(folder, config, cubes, mujoco, rate or RATE)
            skin = read_skin(path)
            rate = rate or skin.rate or RATE
            applied = _applied(skin, load, mujoco)
            if imperfections is not None:
                read_imperfections(imperfections)  # says in one line what is wrong with the file
            verification = LoadVerification(skin, applied) if duration else None
            log = folder / "log.json"
            ports = folder / "ports"
            hubs = SimulatedHubs(
                ports,
                load=load,
                mujoco=mujoco,
                sample_log=log,
                noise=noise,
                imperfections=imperfections,
            )
            processes = skin_processes(path, rate=rate, simulated=hubs)
            if view:
                processes.append(VIEW)
            with ExitStack() as stack:
                table = stack.enter_context(LiveTable(skin, show=not headless))
                children = stack.enter_context(Children(folder))
                for process in processes:
                    children.start(process)
                observer = stack.enter_context(
                    observing("demo", children, interrupted=interrupted, on_step=table.refresh)
                )
                demo = _Demo(skin, rate, children, table, observer, verification)
                demo.wait_for_tensors()
                if view:
                    demo.note_address()
                if duration is None or verification is None:
                    observer.spin(math.inf)
                    return 0
                figures = demo.measure(verification, duration, log)
    except Interrupted:
        # Without a duration Ctrl-C is how it ends.
        return 0 if duration is None else 130
    result = {"cubes": len(skin.cubes), "rate_hz": rate, "duration_s": duration, **figures}
    if figure is not None:
        forces = verification.forces()
        result |= forces.figures()
        picture = draw_forces(
            seconds=forces.seconds,
            force=forces.force,
            measured_force=forces.measured_force,
            centre=forces.centre,
            measured_centre=forces.measured_centre,
            cubes=applied.poses.position,
        )
        save(picture, figure)
    if json_path is None:
        print(json.dumps(result, indent=2))
    else:
        write_json(json_path, result)
        sent, lost = result["samples_sent"], result["lost"]
        print(f"wrote {json_path}: {sent} samples sent, {lost} lost")
    return 0


def _skin_path(
    folder: Path, config: Path | None, cubes: int | None, mujoco: Path | None, rate: float
) -> Path:
    """The skin file of a demo. ConfigError: the options contradict each other."""
    if config is not None:
        return config.resolve()
    if mujoco is None:
        return _skin_file(folder, cubes, rate)
    if cubes is not None:
        raise ConfigError("--cubes makes a skin that no scene knows; name its file with --config")
    return scene_skin(mujoco)


def _applied(skin: Skin, load: Path | None, mujoco: Path | None) -> AnyLoad:
    """What acts on the skin, computed here too. ConfigError: it cannot be used."""
    if mujoco is None:
        return Load(skin, read_script(load) if load else default_script())
    if load is not None:
        raise ConfigError("--load and --mujoco are two loads for one skin; give one of them")
    return MujocoLoad(mujoco, skin)


def _skin_file(folder: Path, cubes: int | None, rate: float) -> Path:
    """The shipped skin file, or that of a grid of so many cubes."""
    if cubes is None:
        return package_data() / "config" / "skin_demo.yaml"
    if not 1 <= cubes <= MOST_CUBES:
        raise ConfigError(f"--cubes is {cubes}, allowed: 1 to {MOST_CUBES}")
    nx = math.ceil(math.sqrt(cubes))
    ny, links = math.ceil(cubes / nx), math.ceil(cubes / CUBES_PER_HUB)
    skin = grid(nx=nx, ny=ny, pitch=PITCH, links=links, rate=rate)
    skin["cubes"] = skin["cubes"][:cubes]
    used = {cube["link"] for cube in skin["cubes"]}
    skin["links"] = [link for link in skin["links"] if link["name"] in used]
    path = folder / "skin.yaml"
    write_yaml(path, skin)
    return path


class _Demo:
    """What is received of the running skin. verification: None where nothing is measured."""

    def __init__(
        self,
        skin: Skin,
        rate: float,
        children: Children,
        table: LiveTable,
        observer: Observer,
        verification: LoadVerification | None,
    ) -> None:
        self._cubes = len(skin.cubes)
        self._children, self._table, self._observer = children, table, observer
        self._verification = verification
        self._another_skin = False
        self._crc_errors: dict[str, int] = {}
        observer.listen(SkinStress, "stress", self._on_stress, queue(rate))
        if verification is not None:
            observer.listen(SkinFrequencies, "frequencies", self._on_frequencies, queue(rate))
            observer.node.create_subscription(
                DiagnosticArray, "/diagnostics", self._on_diagnostics, 10
            )

    def wait_for_tensors(self) -> None:
        """Until every cube has a tensor. What is measured begins when every topic has reached us:
        discovery takes up to seconds. CubeError: they did not come."""

        def ready() -> bool:
            if self._another_skin:
                return True
            if self._verification is None:
                return self._table.seen_all
            return self._table.seen_all and self._verification.sampled and bool(self._crc_errors)

        self._observer.spin(FIRST_TENSORS_S, ready)
        self._check_alone()
        if not self._table.seen_all:
            logs = "\n".join(self._children.log(name)[-1500:] for name in NODES)
            raise CubeError(
                f"after {FIRST_TENSORS_S:g} s only {self._table.seen} of {self._cubes} cubes have "
                f"a tensor.\n{logs}"
            )

    def note_address(self) -> None:
        """Write the address of the browser view above the table."""
        self._observer.spin(FIRST_TENSORS_S, lambda: "http://" in self._children.log("view"))
        address = self._children.wait_for_line("view", "http://", 0.0).split()[0]
        self._table.note = f"\n{address} shows it"

    def measure(
        self, verification: LoadVerification, duration: float, log: Path
    ) -> dict[str, object]:
        """Figures of so many seconds; the simulator ends with it."""
        spin = self._observer.spin
        spin(0.1)
        start_ns, usage = time.time_ns(), Usage(self._children, NODES)
        spin(duration)
        self._check_alone()
        cpu, memory = usage.cpu_percent(), usage.memory_mb()
        end_ns = start_ns + round(duration * 1e9)
        # On a busy machine the simulator takes its samples late.
        spin(LAST_TENSORS_S, lambda: verification.beyond(end_ns))
        verification.compare(end_simulator(self._children, log), start_ns, end_ns)
        spin(LAST_TENSORS_S, verification.complete)
        self._check_alone()
        return {
            **verification.result(),
            "crc_errors": sum(self._crc_errors.values()),
            **{f"cpu_{name}_percent": round(value, 1) for name, value in cpu.items()},
            **{f"rss_{name}_mb": round(value, 1) for name, value in memory.items()},
        }

    def _check_alone(self) -> None:
        """CubeError: another skin publishes here."""
        if self._another_skin or self._observer.node.count_publishers("stress") > 1:
            raise CubeError(
                f"another skin publishes stress in DDS domain {os.environ.get('ROS_DOMAIN_ID', 0)}:"
                " end it, or set another ROS_DOMAIN_ID for this one"
            )

    def _on_stress(self, data: bytes) -> None:
        received_ns = time.time_ns()
        try:
            rows = stress_codec.decode(data).rows
        except MessageError as error:
            self._observer.node.get_logger().error(str(error))
            return
        if int(rows.cube.max(initial=0)) >= self._cubes:
            self._another_skin = True
            return
        if self._verification is not None:
            self._verification.stress(rows, received_ns)
        self._table.update(rows)

    def _on_frequencies(self, data: bytes) -> None:
        if self._verification is not None:
            self._verification.frequencies(frequency_codec.decode(data).rows)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for pair in status.values:
                if pair.key == "crc":
                    self._crc_errors[status.name] = int(pair.value)
