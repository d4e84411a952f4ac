# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube config and ./cube urdf as a user runs them."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from conftest import ROOT
from cube_tensor_driver.cli.config import check_file
from cube_tensor_driver.cli.main import main
from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.tensor import rotation_from_rpy


def cube(*arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "cube_tensor_driver.cli", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False
    )


def test_a_large_grid_is_written_checked_and_drawn_as_frames(tmp_path):
    path = tmp_path / "skin.yaml"
    done = cube(
        "config", "grid", "--nx", 36, "--ny", 35, "--pitch", 0.012, "--links", 16, "-o", path
    )
    assert done.returncode == 0, done.stderr
    skin = read_skin(path)
    assert len(skin.cubes) == 1260 and len(skin.links) == 16
    sizes = [sum(cube.link == link.name for cube in skin.cubes) for link in skin.links]
    assert sum(sizes) == 1260 and max(sizes) - min(sizes) <= 1
    xyz = np.array([cube.xyz for cube in skin.cubes])
    np.testing.assert_allclose(xyz.mean(axis=0), 0, atol=1e-9)  # coordinates are rounded to 1 nm
    assert np.unique(xyz, axis=0).shape == (1260, 3)
    done = cube("config", "check", path)
    assert done.returncode == 0 and "1260 cubes (1260 planar), 16 links" in done.stdout

    robot = ElementTree.fromstring(cube("urdf", path).stdout)
    links = {link.get("name") for link in robot.iter("link")}
    joints = list(robot.iter("joint"))
    assert len(links) == 1261 and len(joints) == 1260
    assert {joint.find("child").get("link") for joint in joints} == links - {"skin_base"}
    assert {joint.find("parent").get("link") for joint in joints} == {"skin_base"}
    origin = joints[0].find("origin")
    np.testing.assert_allclose(np.fromstring(origin.get("xyz"), sep=" "), skin.cubes[0].xyz)
    # URDF's rpy and ours are one convention: fixed axes x, y, z
    np.testing.assert_allclose(
        rotation_from_rpy(*np.fromstring(origin.get("rpy"), sep=" ")), np.eye(3)
    )


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--nx", 0, "--ny", 1], 2, "--nx: '0' is not a whole number of at least 1"),
        (["--nx", 2, "--ny", 1, "--links", 3], 1, "3 links for 2 x 1 cubes"),
        (["--nx", 1000, "--ny", 1000], 1, "1 to 65536 cubes"),
        (["--nx", 2, "--ny", 1, "--links", 2, "--port", "/dev/x"], 1, "appears twice"),
        (["--nx", 1, "--ny", 1, "--layout", "banana"], 1, "'banana'"),
        (["--nx", 1, "--ny", 1, "--name", "a skin"], 1, "name: found 'a skin', allowed: a name"),
        (["--nx", 1, "--ny", 1, "--rate", 1e9], 2, "is not a rate from 0.1 to 10000"),
        (["--nx", 4, "--ny", 4, "--pitch", 12], 1, "divide by 1000 what was typed in mm"),
        (["--nx", 64, "--ny", 64, "--pitch", 12], 1, "divide by 1000 what was typed in mm"),
        (["--nx", 1, "--ny", 1, "--port", "socket://host"], 1, "write socket://host:port"),
    ],
)
def test_a_grid_that_cannot_be(tmp_path, capsys, arguments, code, words):
    try:
        ended = main(["config", "grid", *map(str, arguments), "-o", str(tmp_path / "x.yaml")])
    except SystemExit as usage:
        ended = usage.code
    assert ended == code and words in capsys.readouterr().err
    assert not (tmp_path / "x.yaml").exists()


def test_check_says_what_is_wrong(tmp_path):
    path = tmp_path / "skin.yaml"
    path.write_text("name: skin\nlinks: []\n")
    done = cube("config", "check", path)
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr.splitlines() == [
        f"cube: {path}: top level: the key 'parent_frame', 'cubes' is missing",
        f"cube: {path}: links: found [], allowed: a list of links, at least one",
    ]


def test_a_grid_of_another_layout_has_its_calibration_and_replaces_no_file(tmp_path):
    arguments = "--nx", 2, "--ny", 1, "--layout", "cube", "--port", "/dev/{name}", "-o"
    path = tmp_path / "skin.yaml"
    (tmp_path / "cube").write_text("a program of that name, as in a checkout")
    done = cube("config", "grid", *arguments, path)
    assert done.returncode == 0, done.stderr
    assert {cube.calibration.layout.name for cube in read_skin(path).cubes} == {"cube"}
    before = path.read_bytes()
    done = cube("config", "grid", *arguments, path)
    assert done.returncode == 1 and f"{path}: the file exists" in done.stderr
    assert path.read_bytes() == before


def written(tmp_path, **changes):
    """A skin file of 3 x 1 cubes on 3 links, with changes."""
    skin = describe_grid(nx=3, ny=1, pitch=0.012, rate=100.0, links=3)
    for key, values in changes.items():
        for item, value in zip(skin["cubes" if key == "xyz" else "links"], values, strict=False):
            if key == "xyz":
                item["pose"]["xyz"] = value
            else:
                item[key] = value
    path = tmp_path / "skin.yaml"
    write_yaml(path, skin)
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"port": ["/dev/a", "/dev/a"]}, "the port '/dev/a' appears twice"),
        ({"port": ["socket://host"]}, "'socket://host' is no TCP address: write socket://"),
        ({"xyz": [[0.0, 0.0, 0.1]] * 2}, "'c0', 'c1' are at one place, [0, 0, 0.1] m"),
        ({"xyz": [[-12.0, 0, 0], [0, 0, 0], [12, 0, 0]]}, "what was typed in mm"),
        ({"xyz": [[-1.5, 0, 0], [0, 0, 0], [1.5, 0, 0]]}, "what was typed in mm"),
        (
            {"port": ["/dev/ttyUSB0"], "baud": [9600]},
            "1 of the cubes at 100 Hz send 6900 bytes per second, 9600 baud carry 960",
        ),
    ],
)
def test_check_says_what_no_skin_can_be(tmp_path, capsys, changes, words):
    assert check_file(written(tmp_path, **changes)) == 1
    output = capsys.readouterr()
    assert words in output.err and not output.out


@pytest.mark.parametrize(
    "changes",
    [
        {"port": ["/dev/serial/by-id/*"] * 2},
        {"port": ["socket://[::1]:5", "socket://[::1]:6"]},
        {"xyz": [[0, 0, 0], [1.5, 0, 0], [1.512, 0, 0]]},
        {"port": ["/dev/ttyACM7", "/dev/ttyUSB0"], "baud": [9600, 115200]},
    ],
)
def test_check_accepts_what_may_be_meant(tmp_path, capsys, changes):
    assert check_file(written(tmp_path, **changes)) == 0
    assert "nothing wrong" in capsys.readouterr().out
