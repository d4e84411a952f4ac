# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube fem, ./cube study, ./cube paper as a user runs them: tables, files and pictures out, one
line per mistake."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("skfem", reason="needs skfem: pip install scikit-fem")

from conftest import ROOT
from cube_tensor_design.fem import body as bodies
from cube_tensor_design.fem import memory
from cube_tensor_design.fem.volume_loads import compute_thermal_stress, compute_weight
from cube_tensor_design.paper import experiments as paper
from cube_tensor_design.paper import rod_parts, rod_shear
from cube_tensor_design.studies.layout_study import LayoutStudy
from cube_tensor_driver.cli import main as cli
from cube_tensor_driver.cli.table import PACKAGES
from cube_tensor_driver.config.calibration import (
    find_shipped_calibration,
    read_calibration,
    write_calibration,
)
from cube_tensor_driver.config.yaml import read_yaml
from cube_tensor_driver.core.errors import ElasticError
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.mechanics.influence import read_influence
from cube_tensor_driver.views.terminal.output import show_progress_bar

NARROW = bodies.Body(width=20e-3)
SMALL = "body: {width: 0.02, height: 0.012}\n"
SIX_IN_SPACE = "layout: six.yaml\nbody: {width: 0.012, height: 0.012}\ncube: {rigid: true}\n"


@pytest.fixture
def coarse(monkeypatch):
    monkeypatch.setattr(bodies, "BRICK_SIZES", (bodies.BrickSizes(1.0, 0.3, 6.0),) * 3)


def cube(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "cube_tensor_driver.cli", *map(str, arguments)]


def test_fem_shows_and_writes_what_is_asked(tmp_path):
    model, out, saved = tmp_path / "small.yaml", tmp_path / "fem.json", tmp_path / "mine.yaml"
    model.write_text(SMALL)
    command = cube("fem", model, "--meshes", 2, "--json", out, "--figures", tmp_path / "pictures")
    done = subprocess.run(
        [*command, "-o", str(saved)],
        env=os.environ | {"COLUMNS": "60"},
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=180,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(out.read_text())
    assert {"matrix", "coefficients", "structure_residual", "convergence", "seconds"} <= set(result)
    matrix = np.array(result["matrix"])
    assert matrix.shape == (8, 7)
    assert result["modes"] == ["zz", "zx", "xx", "zz_x", "zz_z", "xx_z", "xx_x"]
    assert list(result["coefficients"]) == ["a", "b", "c_plus_d", "e", "f", "g", "h"]
    unknowns = [row["unknowns"] for row in result["convergence"]]
    assert unknowns == sorted(unknowns)
    assert re.search(rf"V1 \+z-x +{matrix[0, 0]:.4f} +{matrix[0, 1]:.4f} ", done.stdout)
    assert f"{matrix[0, -1]:.4f}" in done.stdout and "…" not in done.stdout
    for words in ("c_plus_d", "change to the next", "left, %", "rank 7 of 7"):
        assert words in done.stdout
    pictures = sorted((tmp_path / "pictures").iterdir())
    assert [path.name for path in pictures] == ["convergence.png", "loads.png", "response.png"]
    assert all(path.stat().st_size > 10_000 for path in pictures)
    assert saved.read_text().startswith(f"# Made by: ./cube fem {model} --meshes 2 -o {saved}\n")
    # A slab has not the full symmetry: seven coefficients would lose part of it.
    assert result["structure_residual"] > 1e-3
    assert np.array_equal(read_calibration(saved).response, matrix)


@pytest.fixture
def fem(tmp_path):
    """Runs `./cube fem` with a model of this text, and returns the exit code."""

    def run(model: str, *arguments: object) -> int:
        path = tmp_path / "model.yaml"
        path.write_text(model)
        return cli.main(["fem", str(path), *map(str, arguments)])

    return run


def test_thermal_stress_is_shown_and_written(fem, tmp_path, capsys):
    saved = tmp_path / "thermal.yaml"
    load = ("--load", "temperature", "--meshes", 2)
    options = (*load, "-o", saved, "--json", tmp_path / "thermal.json")
    assert fem("body: {width: 0.012, expansion: 6.0e-4}", *options) == 0
    shown = capsys.readouterr().out
    stress = read_yaml(saved)
    assert stress["layout"] == "planar" and stress["depth"] == 0.0055
    assert json.loads((tmp_path / "thermal.json").read_text()) == stress
    first = re.search(r"\+z-x +([\d.]+)", shown)
    assert first and float(first[1]) == pytest.approx(stress["pads"][0][0], abs=0.006)
    # Twice the expansion of the default has twice the stress.
    usual = compute_thermal_stress(bodies.Body(width=12e-3), LAYOUTS["planar"], 2).pads
    np.testing.assert_allclose(stress["pads"], 2 * usual, atol=1e-3)
    components = Pipeline([find_shipped_calibration(LAYOUTS["planar"])]).find_matrix(0) @ (
        2 * usual[:, 0]
    )
    assert f"shipped calibration: xx {components[0]:+.1f} Pa/K" in shown
    assert f"zz_z {1e-3 * components[14]:+.1f} Pa/mm/K" in shown


def test_weight_is_shown_and_added_to_a_calibration(fem, tmp_path, capsys):
    saved, model = tmp_path / "heavy.yaml", "body: {width: 0.012, density: 2140.0}\n"
    weight = ("--load", "weight", "--meshes", 1)
    assert fem(model, *weight, "-o", saved) == 0
    shown = capsys.readouterr().out
    shipped, heavy = find_shipped_calibration(LAYOUTS["planar"]), read_calibration(saved)
    assert replace(heavy, weight=None).id == shipped.id != heavy.id
    expected = compute_weight(bodies.Body(width=12e-3, density=2140.0), LAYOUTS["planar"]).pads
    np.testing.assert_allclose(heavy.weight.response, expected)
    components = Pipeline([shipped]).find_matrix(0) @ (9.80665 * expected)
    assert f"z up, measured with the shipped calibration: zz {components[2, 2]:+.1f} Pa" in shown
    assert f"x up, measured with the shipped calibration: zx {components[4, 0]:+.1f} Pa" in shown
    again = tmp_path / "again.yaml"
    model = "calibration: base.yaml\nbody: {width: 0.012}\n"
    base = replace(shipped, source="the base")
    write_calibration(tmp_path / "base.yaml", base)
    assert fem(model, *weight, "-o", again) == 0
    assert replace(read_calibration(again), weight=None).id == base.id
    assert fem(model + "pads: {width: 0.0009}", *weight, "-o", again) == 1
    assert "use a calibration made for that layout" in capsys.readouterr().err
    assert fem("pads: {width: 0.0009}", *weight, "-o", again) == 1
    assert "name one in the model (calibration: FILE)" in capsys.readouterr().err


@pytest.mark.parametrize("layout", ["planar", "cube"])
def test_pads_under_loads_on_the_surface(coarse, fem, tmp_path, capsys, layout):
    out, table = tmp_path / "surface.json", tmp_path / "table.npz"
    in_space = layout == "cube"
    model = f"{{layout: {layout}, body: {{width: 0.014, height: 0.007}}, cube: {{rigid: true}}}}"
    files = ["--json", out, "--figures", tmp_path, *(["-o", table] if in_space else [])]
    assert fem(model, "--load", "surface", "--meshes", 1, *files) == 0
    printed = capsys.readouterr().out
    study = json.loads(out.read_text())
    place, pads = np.array(study["place"]), np.array(study["pads"])
    assert pads.shape == ((24, len(place), 3) if in_space else (8, len(place), 2))
    assert [(row["load"], row["width"], row["offset"]) for row in study["rows"]] == [
        (load, width, place)
        for load in ("press", "rub")
        for width in (2e-3, 5e-3)
        for place in (0.0, 4e-3)
    ]
    above = study["rows"][0]
    unit, places = (1e3, 2) if in_space else (1.0, 1)
    ratio = above["measured"]["zz"] / above["true"]["zz"]
    numbers = [above[key]["zz"] / unit for key in ("measured", "true")]
    row = "press +2 +0 " + " ".join(f"+{number:.{places}f}" for number in numbers)
    assert re.search(rf"{row} +{ratio:.2f}", printed)
    assert (tmp_path / "influence.png").stat().st_size > 10_000
    if in_space:
        written = read_influence(table)
        assert (written.depth, written.layer.thickness) == (3.5e-3, 7e-3)
        assert np.abs(written.pads - pads).max() < 2e-5 * np.abs(pads).max()


def test_a_layout_of_ones_own_in_space(coarse, fem, tmp_path, capsys):
    """One pad in the middle of each face tells the three normal stresses and their slopes along
    themselves. A layout file is looked up beside the model."""
    faces = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]
    out, saved = tmp_path / "fem.json", tmp_path / "mine.yaml"
    (tmp_path / "six.yaml").write_text(
        f"name: six\npad_size: 0.6\npositions: {faces}\nnormals: {faces}\n"
    )
    files = ("--json", out, "--figures", tmp_path, "-o", saved)
    assert fem(SIX_IN_SPACE, "--meshes", 1, *files) == 0
    result = json.loads(out.read_text())
    assert np.array(result["matrix"]).shape == (6, 21) and result["symmetry"] == "full"
    assert result["rank"] == 6 and {"zx", "zz_x"} <= set(result["unobservable"])
    np.testing.assert_allclose(read_calibration(saved).response, result["matrix"], atol=1e-9)
    shown = capsys.readouterr().out
    assert "6 pads, symmetry full" in shown and "unobservable: " in shown
    assert (tmp_path / "response.png").exists()


@pytest.fixture
def computed(monkeypatch):
    """What reaches compute_response, which ends there with an error."""
    calls: list[tuple] = []

    def compute(*arguments):
        calls.append(arguments)
        raise ElasticError("enough")

    monkeypatch.setattr("cube_tensor_design.fem.fem.compute_response", compute)
    return calls


@pytest.mark.parametrize("model", [[], ["planar_slab"]])
def test_defaults(computed, model):
    """planar_slab.yaml lists every default; its symmetry is another one."""
    assert cli.main(["fem", *model]) == 1
    body, layout, symmetry, meshes, _ = computed[0]
    assert body == bodies.Body(
        width=0.06,
        depth=0.06,
        height=0.011,
        side=0.004,
        young=0.3e6,
        poisson=0.48,
        cube_young=200e9,
        cube_poisson=0.30,
        plane="strain",
    )
    assert layout.has_same_pads(LAYOUTS["planar"])
    assert (symmetry, meshes) == ("slab" if model else "full", 3)


def test_every_key_reaches_the_solver(computed, fem):
    model = """
layout: planar
symmetry: mirrors
plane: stress
neglect: [xx]
body: {width: 0.03, depth: 0.04, height: 0.02, young: 1.0e+5, poisson: 0.4}
cube: {side: 0.005, rigid: true, poisson: 0.2, x: 0.001, z: -0.002}
pads: {width: 0.0015, centre: 0.00125}
"""
    assert fem(model, "--meshes", 2) == 1
    body, layout, symmetry, meshes, _ = computed[0]
    assert body == bodies.Body(
        width=0.03,
        depth=0.04,
        height=0.02,
        side=0.005,
        young=1e5,
        poisson=0.4,
        cube_young=np.inf,
        cube_poisson=0.20,
        plane="stress",
        x=1e-3,
        z=-2e-3,
    )
    assert layout.pad_size == pytest.approx(0.6)
    assert layout.positions[1] == pytest.approx([0.5, 0, 1])
    assert (symmetry, meshes) == ("mirrors", 2)


@pytest.mark.parametrize(
    ("pads", "size", "centre"),
    [
        ("{width: 0.0005}", 0.25, 0.5),
        ("{centre: 0.0012}", 0.4, 0.6),
    ],
)
def test_pads(computed, fem, pads, size, centre):
    """A key that is left out has the value of the layout."""
    assert fem(f"pads: {pads}") == 1
    layout = computed[0][1]
    assert layout.pad_size == pytest.approx(size)
    assert layout.positions[1] == pytest.approx([centre, 0, 1])


def work(*_):
    raise RuntimeError("it began to work")


def refused(capsys, arguments, words):
    """In one line that has these words."""
    assert cli.main(arguments.split()) == 1
    message = capsys.readouterr().err
    assert message.startswith("cube: ") and message.count("\n") == 1
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ("body: {poisson: 0.5}", ["body.poisson: found 0.5", "[0, 0.5)"]),
        ("cube: {poisson: 0.5}", ["cube.poisson: found 0.5", "[0, 0.5)"]),
        ("cube: {side: -1.0}", ["cube.side: found -1", "positive number"]),
        ("cube: {z: 0.004}", ["4 mm off the body's centre along z", "3.3 mm off at most"]),
        ("cube: {side: 0.011}", ["side is 11 mm", "height is 11 mm"]),
        (
            "pads: {width: 0.0012, centre: 0.0005}",
            ["+z-x and +z+x overlap: 1.2 mm wide, 1 mm apart", "narrower"],
        ),
        ("pads: {width: 0.0025}", ["2.5 mm", "faces end at 2 mm", "pads.centre"]),
        ("pads: {width: 0.000001}", ["mesh resolves 0.002 mm", "wider"]),
        ("pads: {width: wide}", ["pads.width: found 'wide'", "a number in SI units"]),
        ("{layout: cube, pads: {width: 0.002, centre: 0.001}}", ["overlap"]),
        ("{layout: cube, plane: stress}", ["plane is 'stress'", "'cube'"]),
        ("layout: round", ["unknown layout 'round'"]),
        ("{layout: quad, symmetry: full}", ["lacks this symmetry"]),
        ("symmetry: round", ["symmetry: found 'round'", "full, slab, mirrors or none"]),
        ("neglect: [round]", ["unknown mode 'round'", "zz_x"]),
        ("body: {thickness: 1}", ["body: unknown key 'thickness'", "height"]),
        ("[1]", ["top level: found [1]"]),
    ],
)
def test_a_mistake_in_a_model_is_one_line_before_any_work(
    monkeypatch, capsys, tmp_path, model, words
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cube_tensor_design.fem.fem.make_solid", work)
    Path("model.yaml").write_text(model)
    is_found_by_the_mesh = any(word.startswith(("mesh", "+z-x", "overlap")) for word in words)
    refused(capsys, "fem model.yaml", words if is_found_by_the_mesh else ["model.yaml: ", *words])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("round", ["no file 'round'", "planar_slab"]),
        ("narrow.yaml --load surface", ["width is 8 mm", "make it wider"]),
        ("--load surface -o x.yaml", ["-o x.yaml", "ends in .npz"]),
        ("--load surface -o x.npz", ["-o x.npz", "layout: cube"]),
        ("--load temperature --figures x", ["no pictures of temperature", "leave it out"]),
        ("--load temperature -o x.npz", ["-o x.npz", "a YAML file ends in .yaml"]),
        ("-o x.npz", ["-o x.npz", "a YAML file ends in .yaml"]),
        ("-o none/cube.yaml", ["-o none/cube.yaml", "a folder that can be written"]),
        ("-o /proc/cube.yaml", ["-o /proc/cube.yaml", "a folder that can be written"]),
        ("--json .", ["--json .", "is no file"]),
        ("--json /dev/null", ["--json /dev/null", "is no file"]),
        ("--json x.yaml -o x.yaml", ["-o and --json", "name two files"]),
        ("--figures /proc/x", ["--figures /proc/x", "name a folder"]),
        ("--figures narrow.yaml", ["--figures narrow.yaml", "name a folder"]),
    ],
)
def test_a_mistake_is_one_line_before_any_work(monkeypatch, capsys, tmp_path, arguments, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cube_tensor_design.fem.fem.make_solid", work)
    Path("narrow.yaml").write_text("body: {width: 0.008}")
    refused(capsys, f"fem {arguments}", words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("bench pipeline --json /proc/x", ["--json /proc/x", "can be written"]),
        ("bench scale --figure .", ["--figure .", "is no file"]),
        ("bench scale --figure x.abc", ["x.abc", "no format of a picture"]),
        ("demo --json x --figure x", ["--figure and --json", "name two files"]),
        ("torture --json none/x.json", ["--json none/x.json", "can be written"]),
        ("layout cube --json .", ["--json .", "is no file"]),
        ("study --figure x.abc", ["x.abc", "no format of a picture"]),
        ("fit x.csv --layout cube -o none/c.yaml", ["-o none/c.yaml", "can be written"]),
        ("fit x.csv --layout cube -o c.png", ["-o c.png", "a YAML file ends in .yaml"]),
        ("plot bag -o x.abc", ["x.abc", "no format of a picture"]),
        ("config grid --nx 1 --ny 1 -o /proc/x.yaml", ["-o /proc/x.yaml", "can be written"]),
        ("paper --out /proc/x", ["--out /proc/x", "name a folder"]),
    ],
)
def test_every_output_is_asked_about_before_any_work(
    monkeypatch, capsys, tmp_path, arguments, words
):
    monkeypatch.chdir(tmp_path)
    command = arguments.split()[0]
    monkeypatch.setattr(f"{PACKAGES.get(command, 'cube_tensor_driver')}.cli.{command}.run", work)
    refused(capsys, arguments, words)
    assert not list(tmp_path.iterdir())


def test_too_little_memory_is_said_before_any_work(monkeypatch, capsys):
    monkeypatch.setattr(memory, "find_available_memory", lambda: 1e8)
    monkeypatch.setattr("cube_tensor_design.fem.fem.make_solid", None)
    assert cli.main(["fem", "cube_slab"]) == 1
    assert re.search(
        r"about \d\.\d GB of memory and 0\.1 GB are available", capsys.readouterr().err
    )


def test_control_c_ends_it_quietly(tmp_path):
    command = cube("fem", "-o", tmp_path / "cube.yaml", "--json", tmp_path / "fem.json")
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    ) as process:
        assert (
            process.stdout and "steel cube of 4 mm" in process.stdout.readline()
        )  # it works from here on
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and not errors and not output
    assert not list(tmp_path.iterdir())


def test_control_c_leaves_no_partial_picture(tmp_path):
    model, pictures = tmp_path / "small.yaml", tmp_path / "pictures"
    model.write_text(SMALL)
    command = cube("fem", model, "--meshes", 1, "--figures", pictures)
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        while process.poll() is None and not list(pictures.glob(".*.part")):
            time.sleep(0.001)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and not errors
    assert len(list(pictures.iterdir())) < 3
    for path in pictures.iterdir():
        with Image.open(path) as picture:
            picture.load()


def test_control_c_in_a_destructor_is_not_lost():
    code = """
import signal, sys, threading
from cube_tensor_driver.cli.main import interrupt_again

class Trap:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

sys.unraisablehook = interrupt_again
try:
    Trap()
    threading.Event().wait(10.0)
    print("lost")
except KeyboardInterrupt:
    print("interrupted")
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout == "interrupted\n" and not done.stderr


def test_control_c_ends_work_in_c():
    """A lock that C code waits for without end, as a factorisation that no signal interrupts."""
    code = """
import ctypes, signal
from cube_tensor_design.interrupt import end_at_once

signal.signal(signal.SIGINT, lambda *_: None)  # also where the signal comes before the wait
libc, lock = ctypes.CDLL(None), ctypes.create_string_buffer(64)
with end_at_once():
    libc.pthread_mutex_lock(lock)
    print("waiting", flush=True)
    libc.pthread_mutex_lock(lock)
"""
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        try:
            assert process.stdout and process.stdout.readline() == "waiting\n"
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=20) == 130
        finally:
            process.kill()


def test_an_interrupted_run_leaves_no_file(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("cube_tensor_design.fem.fem.compute_pad_stresses", interrupt)
    assert (
        cli.main(["fem", "-o", str(tmp_path / "cube.yaml"), "--json", str(tmp_path / "fem.json")])
        == 130
    )
    assert not list(tmp_path.iterdir())


def test_an_interrupted_write_leaves_the_old_calibration(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    saved = tmp_path / "cube.yaml"
    saved.write_text("old")
    monkeypatch.setattr(Path, "replace", interrupt)
    assert cli.main(["fem", "--meshes", "1", "-o", str(saved)]) == 130
    assert saved.read_text() == "old"


@pytest.mark.parametrize("name", ["planar", "planar_slab", "quad", "cube"])
def test_shipped_calibrations_are_what_their_commands_make(name, tmp_path, request):
    path = ROOT / "config" / "calibration" / f"{name}.yaml"
    command = re.match(r"# Made by: ./cube (.*)\n", path.read_text())
    assert command
    arguments = shlex.split(command.group(1))
    assert arguments[-2:] == ["-o", f"config/calibration/{name}.yaml"]
    bound = 1e-6  # rounding differs from machine to machine
    if (
        name == "cube"
    ):  # the whole takes minutes: on a coarse mesh it agrees as well as that mesh can
        request.getfixturevalue("coarse")
        arguments[-2:-2], bound = ["--meshes", "1"], 0.05
    arguments[-1] = str(tmp_path / "again.yaml")
    assert cli.main(arguments) == 0
    shipped, again = read_calibration(path), read_calibration(tmp_path / "again.yaml")
    assert np.abs(shipped.response - again.response).max() < bound * np.abs(again.response).max()
    kept = {**again.to_dict(), "id": shipped.id, "coefficients": dict(shipped.coefficients or {})}
    kept["source"] = shipped.source  # the id is a hash of it: it names the options of that time
    assert kept == shipped.to_dict()


def test_study_says_where_to_trust(monkeypatch, tmp_path, capsys):
    """Errors of 50 % under 2 mm and 10 % under 10 mm; the quad layout does not see yy.
    test_virtual_bench runs it."""
    error = {name: np.tile([[[0.5], [0.1]]], (2, 1, 15)) for name in LAYOUTS}
    error["quad"][..., 1] = np.nan
    error["cube"][1] = 0.3
    found = LayoutStudy(
        np.array([2e-3, 1e-3]),
        np.array([2e-3, 1e-2]),
        np.arange(3.0),
        error,
    )
    monkeypatch.setattr(
        "cube_tensor_design.studies.layout_study.study_layouts", lambda progress: found
    )
    assert (
        cli.main(["study", "--json", str(tmp_path / "s.json"), "--figure", str(tmp_path / "s.png")])
        == 0
    )
    result = json.loads((tmp_path / "s.json").read_text())
    assert (
        np.array(result["error"]["cube"]).shape == (2, 2, 15)
        and result["error"]["quad"][0][0][1] is None
    )
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["yy", "·", "·", "10", "10", "10", "never"] in rows and [
        "zz",
        *["10"] * 5,
        "never",
    ] in rows
    assert (tmp_path / "s.png").stat().st_size > 10_000


def test_a_file_gets_no_progress_bar(capsys):
    """Not even an empty line: errors follow on stderr."""
    with show_progress_bar() as report:
        report(1, 2, "half of it")
    assert capsys.readouterr() == ("", "")


def test_paper_makes_its_pictures(monkeypatch, tmp_path):
    told = []

    def one(finite, progress):
        progress(1, 2, "half of it")
        progress(2, 2, "all of it")
        return [_experiment()]

    @contextmanager
    def bar():
        yield lambda done, total, what: told.append(done / total)

    monkeypatch.setattr("cube_tensor_driver.views.terminal.output.show_progress_bar", bar)
    monkeypatch.setattr("cube_tensor_design.figures.paper.run_experiments", one)
    monkeypatch.setattr("cube_tensor_design.paper.virtual_bench.CUBE_REFINEMENTS", 0)
    monkeypatch.setattr(rod_parts, "split_signals", lambda *_: np.ones((2, 5)))
    monkeypatch.setattr(
        "cube_tensor_design.figures.paper.split_rod_signals",
        lambda progress, places=(2e-3,), held="": (
            {} if held else rod_parts.split_rod_signals(NARROW, places=places, progress=progress)
        ),
    )
    monkeypatch.setattr(
        "cube_tensor_design.figures.paper.recover_rod_shear",
        lambda progress: rod_shear.recover_rod_shear(NARROW, places=(2e-3,), progress=progress),
    )
    assert cli.main(["paper", "--out", str(tmp_path / "p")]) == 0
    made = sorted(path.name for path in (tmp_path / "p").iterdir())
    assert made == [
        "experiment_1_finite.png",
        "experiment_1_linear.png",
        "figure_4.png",
        "paper.json",
        "rod_parts.png",
        "rod_shear.png",
    ]
    written = json.loads((tmp_path / "p" / "paper.json").read_text())
    assert written["rod parts"]["sharp rod, strips"]["place"] == [2e-3]
    assert told == sorted(told) and told[0] == 0 and 0.8 < told[-1] <= 1  # one bar


def _experiment() -> paper.Experiment:
    step = np.linspace(0, 1, 3)
    rows = [np.outer(step, np.ones(n)) for n in (8, 3, 7, 7)]
    return paper.Experiment("test", step, *rows, rotation=step)


def test_every_picture_of_the_paper_is_there_and_shown():
    shown = set(
        re.findall(r"\(paper/([a-z0-9_]+\.png)\)", (ROOT / "docs" / "paper.md").read_text())
    )
    assert shown and shown == {path.name for path in (ROOT / "docs" / "paper").glob("*.png")}


def test_the_figures_of_the_papers_page_are_those_of_its_json():
    """paper.json is what ./cube paper wrote beside the pictures; the page quotes its figures."""
    text = " ".join((ROOT / "docs" / "paper.md").read_text().replace("−", "-").split())
    found = json.loads((ROOT / "docs" / "paper" / "paper.json").read_text())
    experiment = {
        "a": "a, top plate pressed, bonded",
        "a, sliding": "a, top plate pressed, sliding",
        "b": "b, pressed 3 mm then sheared, bonded",
        "b, gripped": "b, pressed 3 mm by sliding plates that then grip, sheared",
        "c": "c, 5 mm rod above C2, bonded bottom",
        "c, sliding": "c, 5 mm rod above C2, sliding bottom",
    }

    def last(name: str, kind: str, what: str, column: int, row: int = -1) -> float:
        return found[f"{experiment[name]}, {kind}"][what][row][column] / 1e3

    def four(name: str, digits: int, column: int) -> list[str]:
        """Linear and finite of one experiment at its end, then of its sliding or gripped one,
        kHz."""
        other = {"a": "a, sliding", "b": "b, gripped", "c": "c, sliding"}[name]
        kinds = [(one, kind) for one in (name, other) for kind in ("linear", "finite")]
        return [f"{last(*one, 'prototype', column):.{digits}f}" for one in kinds]

    said = [
        "{} kHz linear, {} kHz finite; sliding: {} and {} kHz".format(*four("a", 1, 0)),
        "{} kHz linear, {} kHz finite; gripped after sliding {} and {} kHz".format(
            *four("b", 2, 1)
        ),
        "{} kHz linear, {} kHz finite; sliding bottom: {} and {} kHz".format(*four("c", 2, 2)),
        "{} kHz linear, {} kHz finite; sliding bottom: {} and {} kHz".format(*four("c", 2, 1)),
    ]
    for name in ("b", "b, gripped"):
        before, after = (last(name, "finite", "prototype", 0, row) for row in (11, 23))
        said.append(f"{before:.2f} → {after:.2f} kHz, {100 * (after / before - 1):.1f} %")
    for name, mode in (("a", 0), ("a, sliding", 0), ("b", 1), ("c", 0)):
        digits = 1 if mode else 0
        said.append(
            " for ".join(
                f"{last(name, 'linear', what, mode):.{digits}f}" for what in ("recovered", "truth")
            )
        )
    for name, other in (("b", "b, gripped"), ("c", "c, sliding")):
        # C1 and C2 on the lower face: P_shear rises.
        for one in (name, other):
            for law in ("linear", "finite"):
                assert last(one, law, "prototype", 1) > 0
    turned = []
    for name, parts in found["fall of P_normal"].items():
        first = found[f"{name}, finite"]["prototype"][11][0]
        _, shear, normal, _, _ = (-100 * part / first for part in parts["signal"])
        turned.append(f"{shear + normal:.1f}")
    said.append("{} of the fall of 2.4 % between bonded plates; after sliding {} %".format(*turned))
    for kind, words in (
        ("rod parts", "{} to {} % up to 3 mm"),
        ("rod parts, held force", "{} to {} %"),
    ):
        shares = [
            round(100 * parts[0] / whole)
            for rod in found[kind].values()
            for place, whole, parts in zip(rod["place"], rod["signal"], rod["parts"], strict=True)
            if place < 3.5e-3
        ]
        said.append(words.format(min(shares), max(shares)))
    slab = read_calibration(ROOT / "config" / "calibration" / "planar_slab.yaml").response[:4]
    said += [
        ", ".join(f"{value:.3f}" for value in slab[:, column]) for column in (1, 3)
    ]  # zx and zz_x
    recovered = {name: np.array(found["rod shear"][name]) for name in ("pads", "eq_4", "tensor")}
    errors = {
        name: np.abs(shear - found["rod shear"]["same_load"]).max() / 1e3
        for name, shear in recovered.items()
    }
    said.append(f"within {errors['pads']:.1f} kPa, a twentieth of the largest shear")
    said.append(
        f"{errors['eq_4']:.0f} kPa off and the tensor of eight pads {errors['tensor']:.0f} kPa"
    )
    assert len(said) == 17
    for words in said:
        assert words in text, words
    # The finest step of the rod: the mesh of the pictures, in the table of meshes.
    pads = 1e-3 * np.array(found[f"{experiment['c']}, finite"]["pads"])[:, :4]
    both = pads @ np.array([[-1, 1, 1, -1], [1, -1, 1, -1]]).T
    meshes = json.loads((ROOT / "docs" / "paper" / "convergence.json").read_text())
    _, *row = meshes["rod of experiment (c), bonded bottom, finite strain"]["rows"][0]
    assert np.allclose(row, both[[3, 5, 7, 9, 11]], atol=0.005)
