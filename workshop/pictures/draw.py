"""The pictures of the documentation, made from a running demo, the benchmark and the studies."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from cube_tensor_design.figures.experiments import draw_prototype
from cube_tensor_design.figures.field import draw_field, draw_field_study, field_tables
from cube_tensor_design.figures.pads_example import draw_pads, draw_sweep
from cube_tensor_design.figures.traction import (
    draw_layer,
    draw_traction,
    pads_table,
    traction_table,
)
from cube_tensor_design.paper.experiments import experiments
from cube_tensor_design.studies.field_study import field_example, field_study
from cube_tensor_design.studies.pads_example import planar_calibration, sweep
from cube_tensor_design.studies.pads_study import coarse_influence, layer_example, study_pads
from cube_tensor_design.studies.traction_study import MAIN, PITCHES, SHAPED, WRONG, traction_example
from cube_tensor_design.studies.traction_study import study as traction_study
from cube_tensor_driver.cli import ROOT
from cube_tensor_driver.config.package_data import package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.errors import ConfigError, CubeError
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import Process, SimulatedHubs, skin_processes
from cube_tensor_driver.simulation.mujoco.scene import MujocoLoad, scene_skin
from cube_tensor_driver.views.figures.style import save

from ..bench.skin import bench_scale
from .cube_drawing import draw_cube
from .fingers import draw_fingers

START_S = 30.0
"""How long the processes may take to start."""
LOAD = """\
period: 8.0
indenters:
- name: finger
  shape: disc
  radius: 0.006
  friction: 0.5
  does:
  - press:
      from: 0.0
      to: 8.0
      at: [-0.004, -0.003, 0]
      force: [0, 2.6, 2.6, 2.6, 0]
      shear: [1.0, 0.4, 0]
"""
"""Presses beside the cube c05, whose numbers the browser view shows at first, and rests there."""
SHAKEN_S = 2.62
"""When the box of the gripper is accelerated most, s."""
PHOTOGRAPH_S = 120.0
"""How long the browser may take to make its picture."""
CONTACT_WIDTHS, LOADS, SEED = [2e-3, 5e-3, 10e-3, 20e-3], 100, 7031
"""Balls of the traction's tables: widths, m, how many, and a seed that nothing was chosen with."""
COUNTS, RATE, MEASURE_S = [1, 4, 16, 64, 256, 1024, 4096], 100.0, 6.0
"""Cubes, Hz and seconds of the scale plot: most machines can do that."""


def make_pictures(folder: Path) -> None:
    """Write all pictures and figures of the documentation; view.png only where Chromium is.

    Prints the tables of the field study and of the traction study. CubeError: something did not
    start, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"{folder}: {error.strerror}; name a folder that can be written"
        ) from None
    if shutil.which("chromedriver"):
        with _demo_skin() as children:
            _photograph(children, folder / "view.png")
    else:
        print(
            "no view.png: it needs Chromium, apt-get install chromium chromium-driver",
            file=sys.stderr,
        )
    try:
        _draw_gripper(folder / "gripper.png")
    except ConfigError as error:
        print(f"no gripper.png: {error}", file=sys.stderr)
    bench_scale(
        counts=COUNTS,
        rate=RATE,
        duration=MEASURE_S,
        json_path=folder / "scale.json",
        figure=folder / "scale.png",
    )
    save(draw_cube(planar_calibration()), folder / "cube.png")
    save(draw_pads(planar_calibration()), folder / "pads.png")
    save(draw_sweep(sweep()), folder / "mistaken_shear.png")
    a, _, b, _, c, _ = experiments()
    save(draw_prototype([a, b, c]), folder / "prototype.png")
    save(draw_field(field_example()), folder / "field.png")
    study = field_study()
    save(draw_field_study(study), folder / "field_error.png")
    save(draw_traction(traction_example()), folder / "traction.png")
    balls = traction_study((*MAIN, *PITCHES), CONTACT_WIDTHS, LOADS, seed=SEED)
    print(traction_table({f"{s.cubes}, {1e3 * s.pitch:g} mm": e for s, e in balls.items()}))
    settings = traction_study(list(WRONG.values()), [5e-3, 15e-3], cases=6, seed=SEED)
    print(traction_table({name: settings[one] for name, one in WRONG.items()}))
    shaped = traction_study(SHAPED, CONTACT_WIDTHS, cases=6, seed=SEED)
    names_of = {s: f"{s.shape}, {s.cubes}, {1e3 * s.pitch:g} mm" for s in shaped}
    print(traction_table({names_of[s]: errors for s, errors in shaped.items()}))
    pads = coarse_influence()
    save(draw_layer(layer_example(pads)), folder / "thin_layer.png")
    print(pads_table(study_pads(pads, CONTACT_WIDTHS, cases=40, seed=SEED)))
    names = ("pitches", "widths", "error", "position", "force")
    table = {name: getattr(study, name).tolist() for name in names}
    (folder / "field.json").write_text(json.dumps(table) + "\n")
    written = ", ".join(sorted(path.name for path in folder.iterdir()))
    print(f"{field_tables(study)}\nwrote {written} to {folder}")


def _draw_gripper(path: Path) -> None:
    """The gripper while it shakes its box, and what its fingers feel. ConfigError: no OpenGL."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    scene = package_data() / "config" / "mujoco" / "gripper.xml"
    skin = read_skin(scene_skin(scene))
    load = MujocoLoad(scene, skin, noise=None)
    load.play(SHAKEN_S)
    pixels = load.picture(760, 900, lookat=np.array([0.0, 0.0, 0.1]), distance=0.25, azimuth=150.0)
    links = np.array([cube.link for cube in skin.cubes])
    fingers = {name: np.flatnonzero(links == name) for name in ("left", "right")}
    save(draw_fingers(pixels, load.poses, load.touch.read(), fingers, load.depth), path)


@contextmanager
def _demo_skin() -> Iterator[Children]:
    """The simulated demo skin under its load, with the browser view."""
    skin = package_data() / "config" / "skin_demo.yaml"
    with (
        tempfile.TemporaryDirectory(prefix="cube_pictures_") as name,
        Children(Path(name)) as children,
    ):
        load = Path(name) / "load.yaml"
        load.write_text(LOAD)
        hubs = SimulatedHubs(Path(name) / "ports", load=load, noise=None)
        for process in skin_processes(skin, contacts=True, simulated=hubs):
            children.start(process)
        children.start(Process("view", "cube_tensor_driver.cli", False, arguments=("view",)))
        yield children


def _photograph(children: Children, path: Path) -> None:
    """The browser view. CubeError: no picture came."""
    url = children.wait_for_line("view", "http://", START_S).split()[0]
    # In a process of its own, so that only a machine with Chromium needs selenium.
    command = [sys.executable, "-m", "workshop.pictures.photograph", url, str(path.resolve())]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=PHOTOGRAPH_S, check=False
    )
    if done.returncode:
        raise CubeError(f"no picture of {url}:\n{done.stderr[-500:]}")
