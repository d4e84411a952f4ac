# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The pictures of the documentation, made from a running demo, the benchmark and the studies."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cube_tensor_design.figures.experiments import draw_prototype
from cube_tensor_design.figures.field import draw_field_study, draw_methods, draw_traction
from cube_tensor_design.figures.pads_example import draw_pads, draw_sweep
from cube_tensor_design.paper.experiments import run_experiments
from cube_tensor_design.studies.field_study import compute_field_example, study_fields
from cube_tensor_design.studies.pads_example import read_planar_calibration, sweep
from cube_tensor_design.studies.pads_study import compute_coarse_influence, compute_layer_example
from cube_tensor_design.studies.traction_study import compute_traction_example
from cube_tensor_driver.config.output_files import write_json
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import VIEW, SimulatedHubs, list_skin_processes
from cube_tensor_driver.simulation.mujoco.scene import MujocoLoad, find_scene_skin
from cube_tensor_driver.simulation.mujoco.source import load_mujoco
from cube_tensor_driver.views.figures.style import save

from ..bench.contacts import bench_shapes
from ..bench.contacts_figure import draw_shapes
from ..bench.skin import Bench, bench_scale
from .contact_tables import write_contact_tables
from .fingers import draw_fingers

START_S = 30.0
"""Longest time for the processes to start, in s."""
LOAD = """\
period: 16.0
indenters:
- name: finger
  shape: disc
  radius: 0.006
  friction: 0.5
  does:
  - press:
      from: 0.0
      to: 16.0
      at: [-0.004, -0.003, 0]
      force: [0, 2.6, 2.6, 2.6, 0]
      shear: [1.0, 0.4, 0]
"""
"""Load script of the browser view's picture. It presses beside the cube c05, whose numbers the view
shows at first, and stays there."""
ERROR_LEVELS = (0.1, 0.2, 0.3, 0.5)
"""Relative errors of the pressure for which field.json states how many fewer cubes are needed if
they also measure gradients."""
SHAKEN_S = 2.62
"""Time at which the acceleration of the gripper's box is largest, in s."""
CAMERA_TARGET = (0.0, 0.0, 0.1)
"""Position, in m in the world of the gripper's scene, at the centre of its picture."""
SHAPE_LOADS = 40
"""Number of random loads of each shape in contacts.png."""
COUNTS = [1, 4, 16, 64, 256, 1024, 4096]
"""Numbers of cubes in the scale plot."""
RATE = 100.0
"""Sampling rate of the cubes in the scale plot, in Hz, which most computers can process."""
MEASURE_S = 6.0
"""Duration of each measurement of the scale plot, in s."""


def make_pictures(folder: Path) -> None:
    """Write all pictures and tables of the documentation; view.png only where Chromium is.

    Raises:
        CubeError: Something did not start, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"{folder}: {error.strerror}; name a folder that can be written"
        ) from None
    if shutil.which("chromedriver"):
        with _run_demo_skin() as children:
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
    scale = bench_scale(COUNTS, Bench(RATE, MEASURE_S), folder / "scale.png")
    write_json(folder / "scale.json", scale)
    save(draw_pads(read_planar_calibration()), folder / "pads.png")
    save(draw_sweep(sweep()), folder / "mistaken_shear.png")
    a, _, b, _, c, _ = run_experiments()
    save(draw_prototype([a, b, c]), folder / "prototype.png")
    save(draw_methods(compute_field_example()), folder / "field.png")
    study = study_fields()
    save(draw_field_study(study), folder / "field_error.png")
    saved = {
        f"cubes saved at an error of {level}": study.compute_cubes_saved(level)
        for level in ERROR_LEVELS
    }
    write_json(folder / "field.json", vars(study) | saved)
    save(draw_traction(compute_traction_example()), folder / "traction.png")
    true_pads = compute_coarse_influence()
    save(
        draw_methods(compute_layer_example(true_pads), "cubes as "),
        folder / "thin_layer.png",
    )
    shapes = bench_shapes(SHAPE_LOADS)
    save(draw_shapes(shapes), folder / "contacts.png")
    write_contact_tables(folder / "contacts.json", true_pads, shapes)
    written = ", ".join(sorted(path.name for path in folder.iterdir()))
    print(f"wrote {written} to {folder}")


def _draw_gripper(path: Path) -> None:
    """Draw the gripper while it shakes its box, and the stress on its fingers.

    Raises:
        ConfigError: There is no OpenGL.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")
    scene = find_package_data() / "config" / "mujoco" / "gripper.xml"
    skin = read_skin(find_scene_skin(scene))
    load = MujocoLoad(scene, skin, noise=None)
    load.compute_stress_field(SHAKEN_S)  # computes the scene up to this time
    pixels = _render(load)
    links = np.array([cube.link for cube in skin.cubes])
    fingers = {name: np.flatnonzero(links == name) for name in ("left", "right")}
    save(
        draw_fingers(pixels, load.poses, load.touch.read(), fingers, load.depth),
        path,
    )


def _render(load: MujocoLoad) -> NDArray[np.uint8]:
    """Render the scene of a load as it is now; return its pixels (height, width, 3).

    Raises:
        ConfigError: OpenGL cannot draw here.
    """
    mujoco = load_mujoco()
    camera = mujoco.MjvCamera()
    camera.lookat[:] = CAMERA_TARGET
    camera.distance = 0.25  # m
    camera.azimuth = 150.0  # degrees
    camera.elevation = -12.0  # degrees; a negative value means that it looks down
    try:
        with mujoco.Renderer(load.touch.model, 760, 900) as renderer:
            renderer.update_scene(load.touch.data, camera)
            pixels: NDArray[np.uint8] = renderer.render()
    except (ImportError, AttributeError, RuntimeError, OSError, mujoco.FatalError) as error:
        raise ConfigError(
            f"MuJoCo cannot draw without a display ({error}): apt-get install libegl1 "
            "libegl-mesa0, and set MUJOCO_GL=egl"
        ) from None
    return pixels


@contextmanager
def _run_demo_skin() -> Iterator[Children]:
    """Run the simulated demo skin under its load, with the browser view."""
    skin = find_package_data() / "config" / "skin_demo.yaml"
    with (
        tempfile.TemporaryDirectory(prefix="cube_pictures_") as name,
        Children(Path(name)) as children,
    ):
        load = Path(name) / "load.yaml"
        load.write_text(LOAD)
        hubs = SimulatedHubs(Path(name) / "ports", load=load, noise=None)
        for process in list_skin_processes(skin, contacts=True, simulated=hubs):
            children.start(process)
        children.start(VIEW)
        yield children


def _photograph(children: Children, path: Path) -> None:
    """Save a picture of the browser view.

    Raises:
        WebDriverException: The browser made no picture.
    """
    # Only a machine with Chromium needs selenium, which this module imports.
    from .photograph import photograph

    photograph(children.wait_for_line("view", "http://", START_S).split()[0], path)
