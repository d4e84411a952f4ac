# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Skin files: what is read; and that every mistake gives one message with the file, the key, what
was found and what is allowed."""

from __future__ import annotations

import copy
import os
from pathlib import Path

import numpy as np
import pytest
import yaml

from cube_tensor_driver.calibrate.load_table import read_loads
from cube_tensor_driver.config.calibration import read_calibration
from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Elastomer, check_skin, read_skin
from cube_tensor_driver.config.yaml import parse_yaml, write_yaml
from cube_tensor_driver.core.errors import ConfigError, FitError
from cube_tensor_driver.touch.inverse import SurfaceInverse

GOOD = describe_grid(nx=3, ny=2, pitch=0.012, links=2, rate=100.0)


def read(tmp_path: Path, data: object):
    path = tmp_path / "skin.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return read_skin(path)


@pytest.mark.parametrize("name", ["skin_demo.yaml", "cube.yaml"])
def test_shipped_skins(name):
    skin = read_skin(find_package_data() / "config" / name)
    assert len(skin.cubes) == {"skin_demo.yaml": 16, "cube.yaml": 1}[name]
    assert skin.n_pads == 8


def test_shipped_calibrations_have_their_id():
    paths = sorted((find_package_data() / "config" / "calibration").glob("*.yaml"))
    assert paths
    for path in paths:
        assert read_calibration(path).id in path.read_text()


def test_grid_deals_every_cube_once():
    # 7 cubes on 3 links are 3, 2 and 2. Indices begin with 0 on each link. Positions are centred.
    data = describe_grid(nx=7, ny=1, pitch=0.5, links=3, rate=10.0, port="p{}")
    assert [(cube["link"], cube["index"]) for cube in data["cubes"]] == [
        ("hub0", 0),
        ("hub0", 1),
        ("hub0", 2),
        ("hub1", 0),
        ("hub1", 1),
        ("hub2", 0),
        ("hub2", 1),
    ]
    assert [cube["pose"]["xyz"][0] for cube in data["cubes"]] == [
        -1.5,
        -1.0,
        -0.5,
        0.0,
        0.5,
        1.0,
        1.5,
    ]


def test_pose_and_uid(tmp_path):
    data = copy.deepcopy(GOOD)
    del data["cubes"][4]["index"]
    data["cubes"][4].update(uid="0xc0be", pose={"xyz": [1, 2, 3], "rpy": [0.1, 0.2, 0.3]})
    cube = read(tmp_path, data).cubes[4]
    assert (cube.uid, cube.index, cube.xyz, cube.rpy) == (
        0xC0BE,
        None,
        (1.0, 2.0, 3.0),
        (0.1, 0.2, 0.3),
    )


@pytest.mark.parametrize(("thickness", "expected"), [(0.011, 0.011), (0, np.inf)])
def test_the_inverse_of_a_skin_takes_its_elastomer(tmp_path, thickness, expected):
    data = copy.deepcopy(GOOD)
    data["elastomer"] = {"depth": 0.005, "thickness": thickness}
    skin = read(tmp_path, data)
    assert skin.elastomer == Elastomer(0.005, expected, 0.48)
    inverse = SurfaceInverse(skin)
    assert (inverse.depth, inverse.layer.thickness) == (0.005, expected)
    assert read(tmp_path, GOOD).elastomer is None


def change(*path, to=None, remove=False):
    def apply(data):
        for part in path[:-1]:
            data = data[part]
        if remove:
            del data[path[-1]]
        else:
            data[path[-1]] = to

    return apply


@pytest.mark.parametrize(
    ("break_it", "words"),
    [
        (
            change("speed", to=3),
            ["top level", "unknown key 'speed'", "allowed: name, parent_frame"],
        ),
        (change("links", 0, "prot", to="x"), ["links[0]", "'prot'", "name, port, baud"]),
        (
            change("cubes", 3, "pose", "xyz", to=[1, 2]),
            ["cubes[3].pose.xyz", "found [1, 2]", "three finite numbers"],
        ),
        (
            change("cubes", 1, "index", to="two"),
            ["cubes[1].index", "'two'", "integer from 0 to 65535"],
        ),
        (change("cubes", 1, "index", to=-1), ["cubes[1].index", "found -1", "0 to 65535"]),
        (change("cubes", 2, "name", to="c 2"), ["cubes[2].name", "'c 2'", "letters, digits"]),
        (change("cubes", 2, "name", to="c1"), ["cubes", "name 'c1' appears twice"]),
        (change("cubes", 2, "name", to="c2\n"), ["cubes[2].name", "letters, digits"]),
        (change("cubes", 2, "name", to="c" * 65), ["cubes[2].name", "at most 64"]),
        (change("cubes", 2, "name", to="2c"), ["cubes[2].name", "a letter first"]),
        (change("name", to="haut_ß"), ["name: found 'haut_ß'", "letters, digits"]),
        (change("parent_frame", to="/base"), ["parent_frame", "'/base'", "a letter first"]),
        (change("links", 1, "name", to="hub0"), ["links", "name 'hub0' appears twice"]),
        (change("cubes", 2, "link", to="hub9"), ["cubes[2].link", "'hub9'", "hub0, hub1"]),
        (change("cubes", 2, "index", to=1), ["link and index 'hub0', 1 appears twice"]),
        (change("cubes", 2, "uid", to=5), ["cubes[2]", "either a uid, or a link and an index"]),
        (
            change("cubes", 2, "index", remove=True),
            ["cubes[2]", "either a uid, or a link and an index"],
        ),
        (
            change("cubes", 2, "link", remove=True),
            ["cubes[2]", "either a uid, or a link and an index"],
        ),
        (change("cubes", 0, "layout", to="cube"), ["cubes[0].layout", "'cube'", "'planar'"]),
        (
            change("cubes", 0, "calibration", to="nope"),
            ["cubes[0].calibration", "'nope'", "planar, planar_slab"],
        ),
        (change("links", to=[]), ["links", "at least one"]),
        (
            change("links", 1, "port", to="spy:///dev/null?file=/tmp/x"),
            ["links: port of hub1", "'spy:///dev/null?file=/tmp/x'", "a device path"],
        ),
        (change("parent_frame", remove=True), ["'parent_frame' is missing"]),
        (change("elastomer", to={"depth": 0.005}), ["elastomer", "'thickness' is missing"]),
        (
            change("elastomer", to={"depth": 0.012, "thickness": 0.011}),
            ["elastomer.depth", "0.012", "below the thickness"],
        ),
        (
            change("elastomer", to={"depth": 0.005, "thickness": 0, "poisson": 0.6}),
            ["elastomer.poisson", "found 0.6", "0 to 0.5"],
        ),
        (change("rate", to=0), ["rate", "found 0", "0.1 to 10000"]),
        (change("rate", to=float("nan")), ["rate", "found nan"]),
        (
            change("cubes", 0, "pose", "rpy", to=[0.0, float("inf"), 0.0]),
            ["pose.rpy[1]", "found inf", "finite"],
        ),
    ],
)
def test_one_message_per_mistake(tmp_path, break_it, words):
    data = copy.deepcopy(GOOD)
    break_it(data)
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, data)
    text = str(caught.value)
    assert str(tmp_path / "skin.yaml") in text
    for word in words:
        assert word in text
    assert "\n" not in text


def test_a_skin_shows_itself_in_one_line():
    shown = repr(read_skin(find_package_data() / "config" / "skin_demo.yaml"))
    assert shown == "<Skin 'skin': 16 cubes (planar) on 2 links, 100 Hz>"


def test_names_and_calibrations_are_in_the_order_of_the_cubes(tmp_path):
    data = copy.deepcopy(GOOD)
    for cube in data["cubes"][3:]:
        cube.update(layout="cube", calibration="cube")
    skin = read(tmp_path, data)
    assert skin.names == ("c0", "c1", "c2", "c3", "c4", "c5")
    assert [one.layout.name for one in skin.calibrations] == 3 * ["planar"] + 3 * ["cube"]
    assert skin.n_pads == 24


def test_uids_once_in_any_spelling(tmp_path):
    data = copy.deepcopy(GOOD)
    for number, uid in ((1, 0x1F), (4, "0x1F")):
        del data["cubes"][number]["index"]
        data["cubes"][number]["uid"] = uid
    for link in data["links"]:
        link["hub_uid"] = 7
    with pytest.raises(
        ConfigError, match=r"hub_uid 0x7 appears twice; .* \(and 1 more: ./cube config check"
    ):
        read(tmp_path, data)
    path = tmp_path / "skin.yaml"
    assert check_skin(path)[1] == [
        "links: the hub_uid 0x7 appears twice; keep one",
        "cubes: the uid 0x1f appears twice; keep one",
    ]


def test_a_hub_reads_one_number_of_pads(tmp_path):
    data = copy.deepcopy(GOOD)
    data["cubes"][1].update(layout="cube", calibration="cube")
    with pytest.raises(
        ConfigError, match="those on the link 'hub0' have 8 and 24 pads; a hub reads one number"
    ):
        read(tmp_path, data)


def test_every_mistake_is_listed(tmp_path):
    """First all those of single keys, then those that concern several keys or files."""
    data = copy.deepcopy(GOOD)
    data["cubes"][1]["calibration"] = "nope"
    data["cubes"][2]["layout"] = "cube"
    data["cubes"][5]["name"] = "c4"
    others = ["cubes[1].calibration", "cubes[2].layout", "cubes: the name 'c4'"]
    path = tmp_path / "skin.yaml"
    path.write_text(yaml.safe_dump(data))
    check_starts(check_skin(path), others)
    del data["parent_frame"]
    data["links"][1]["baud"] = 3
    data["cubes"][0]["name"] = "c 0"
    path.write_text(yaml.safe_dump(data))
    keys = ["top level: the key 'parent_frame'", "cubes[0].name", "links[1].baud"]
    check_starts(check_skin(path), keys)


def check_starts(checked, starts):
    skin, mistakes = checked
    assert skin is None
    for line, start in zip(mistakes, starts, strict=True):
        assert line.startswith(start)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\nb: 2\na: 3\n", ["line 3", "'a' appears twice"]),
        ("a: [1, 2", ["line", "expected"]),
        ("!!python/object/apply:os.system ['true']", ["line 1"]),
        ("", ["top level", "found None"]),
        ("[1, 2]", ["top level", "found [1, 2]"]),
        ("\x00\x01", ["not YAML"]),
        ("? [1]\n: 2\n", ["line 1", "unhashable key"]),
    ],
)
def test_what_is_not_a_skin_at_all(tmp_path, text, words):
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, text)
    for word in words:
        assert word in str(caught.value)


def test_missing_file_and_folder_and_size(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="No such file"):
        read_skin(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="Is a directory"):
        read_skin(tmp_path)
    monkeypatch.setattr("cube_tensor_driver.config.input_files.MAX_BYTES", 10)
    with pytest.raises(ConfigError, match="the limit is 10"):
        read(tmp_path, GOOD)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("/dev/zero", ["a device", "regular file"]),
        ("pipe", ["a pipe", "regular file"]),
        ("/proc/self/maps", ["the limit is 1000"]),  # its size is 0
    ],
)
def test_only_regular_files_are_read_and_only_up_to_their_limit(tmp_path, monkeypatch, path, words):
    """A device has no end and a pipe waits for ever: neither is read at all."""
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr("cube_tensor_driver.config.input_files.MAX_BYTES", 1000)
    layout = read_skin(find_package_data() / "config" / "cube.yaml").calibrations[0].layout
    for read_one in (read_skin, lambda at: read_loads(at, layout)):
        with pytest.raises((ConfigError, FitError)) as caught:
            read_one(tmp_path / path)
        assert "\n" not in str(caught.value)
        for word in words:
            assert word in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 200_000, ["lists and mappings within each other", "100"]),
        ("{a: " * 200_000, ["lists and mappings within each other"]),
        ("- " * 200_000, ["lists and mappings within each other"]),
        ("links: &a [*a]", ["is missing"]),
        ("rate: 0x" + "f" * 900, ["is missing"]),
        ("rate: !!bool maybe", ["not YAML"]),
        ("rate: !!timestamp never", ["not YAML"]),
    ],
    ids=lambda part: part[:12] if isinstance(part, str) else "",
)
def test_what_yaml_does_not_refuse_itself_is_one_line(tmp_path, text, words):
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
    for word in words:
        assert word in str(caught.value)


def test_merged_keys_may_be_overridden():
    assert parse_yaml("a: &a {x: 1, y: 2}\nb: {<<: *a, x: 3}", "t")["b"] == {"x": 3, "y": 2}


def test_written_files_read_back_and_leave_no_temporary_file(tmp_path):
    path = tmp_path / "s.yaml"
    write_yaml(path, GOOD, "two\nlines")
    assert path.read_text().startswith("# two\n# lines\n")
    assert yaml.safe_load(path.read_text()) == GOOD
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ConfigError, match="can be written"):
        write_yaml(tmp_path / "none" / "s.yaml", GOOD)
