"""docs/messages.md, docs/parameters.md and docs/troubleshooting.md against the package."""

from __future__ import annotations

import ast
import importlib
import os
import re
import shutil
import subprocess
from dataclasses import fields as fields_of
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")
pytest.importorskip("skfem", reason="needs skfem: pip install scikit-fem")

from bag_maker import make_bag
from test_docs_python import blocks

import cube_tensor_driver as ctd
from conftest import ROOT
from cube_tensor_driver.core.defaults import FOAM_MODULUS, FREQUENCY_NOISE, POISSONS_RATIO
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.elastic import contact
from cube_tensor_driver.research.pads_example import planar_calibration
from cube_tensor_driver.ros.parameters import (
    CONTACTS,
    DRIVER,
    MARKERS,
    RECONSTRUCTION,
    Parameter,
)

PAGE = ROOT / "docs" / "messages.md"
INTERFACES = sorted([*ROOT.glob("msg/*.msg"), *ROOT.glob("srv/*.srv")])
PARAMETERS = ROOT / "docs" / "parameters.md"
NODES = {
    "driver": DRIVER,
    "reconstruction": RECONSTRUCTION,
    "markers": MARKERS,
    "contacts": CONTACTS,
}
ENTRIES = 900
"""Of an array whose length is free: a multiple of all widths."""
RCLCPP = """
#pragma once
#include <cstdio>
#include <functional>
#include <memory>
#define RCLCPP_INFO(logger, ...) (void)(logger), std::printf(__VA_ARGS__)
namespace rclcpp {
template<class M> struct Subscription { using SharedPtr = std::shared_ptr<Subscription>; };
struct QoS { explicit QoS(size_t) {} QoS & transient_local() { return *this; } };
struct Node {
  explicit Node(const char *) {}
  int get_logger() { return 0; }
  template<class M>
  typename Subscription<M>::SharedPtr create_subscription(
    const char *, const QoS &, std::function<void (const M &)>) { return {}; }
};
inline void init(int, char **) {}
inline void spin(std::shared_ptr<Node>) {}
inline void shutdown() {}
}
"""
"""What the page's program calls of rclcpp, for a machine without it."""


def table(page: Path, heading: str) -> list[list[str]]:
    """The rows of the first table below a heading, without its head."""
    section = page.read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = section[section.index("|---") :].split("\n\n")[0].splitlines()[1:]
    return [re.split(r"\s*\|\s*", line)[1:-1] for line in lines]


def fields(path: Path) -> list[tuple[str, str]]:
    """Name and type of each field of a message, or of a service's request and answer."""
    lines = (line.split("#")[0].split() for line in path.read_text().splitlines())
    return [(words[1], words[0]) for words in lines if len(words) == 2 and "=" not in words[1]]


def filled(kind: Any) -> Any:
    """A message with something in each of its arrays."""
    message = kind()
    for name, of in kind.get_fields_and_field_types().items():
        array = re.fullmatch(r"sequence<(?:(\w+)/)?(\w+)>", of)
        if array and array[1]:
            inner = getattr(importlib.import_module(f"{array[1]}.msg"), array[2])
            setattr(message, name, [filled(inner)] * ENTRIES)
        elif array:
            setattr(message, name, ["" if array[2] == "string" else 0] * ENTRIES)
    return message


def parameter_table() -> list[str]:
    """The parameters of all nodes as a table. What several nodes share has one line."""
    nodes: dict[Parameter, list[str]] = {}
    for node, parameters in NODES.items():
        for parameter in parameters:
            nodes.setdefault(parameter, []).append(f"`{node}`")
    lines = [
        "| parameter | node | default | allowed | live | what it sets |",
        "|---|---|---|---|---|---|",
    ]
    for each, of in nodes.items():
        default = f"`{each.default}`" if each.default != "" else "empty"
        allowed = each.choices or {bool: "true, false"}.get(type(each.default), "text")
        if each.span:
            low, high = (np.format_float_positional(limit, trim="-") for limit in each.span)
            allowed = f"0, {each.least:g} to {high}" if each.least else f"{low} to {high}"
        live = "yes" if each.live else "no"
        shown = ["`" + each.name + "`", ", ".join(of), default.lower(), allowed, live]
        lines.append(f"| {' | '.join(shown)} | {each.description} |")
    return lines


@pytest.mark.parametrize("path", INTERFACES, ids=lambda path: path.stem)
def test_table_of_a_message_has_its_fields(path):
    rows = table(PAGE, path.stem)
    assert [(row[0].strip("`"), row[1].split(",")[0]) for row in rows] == fields(path)
    assert all(len(row) == 4 and all(row) for row in rows)


def test_examples_of_the_tables_read_a_message():
    messages = importlib.import_module("cube_tensor_driver.msg")
    services = importlib.import_module("cube_tensor_driver.srv")
    there = {"np": np, "row": 1, "cube": 0, "pad": 2, "info": filled(messages.SkinInfo)}
    there |= {"SkinInfo": messages.SkinInfo, "SkinStress": messages.SkinStress}
    for path in INTERFACES:
        if path.suffix == ".srv":
            kind = getattr(services, path.stem)
            there |= {"request": filled(kind.Request), "response": filled(kind.Response)}
        elif path.stem == "StressTensor":
            there["message"] = filled(messages.StressTensorStamped)
        else:
            there["message"] = filled(getattr(messages, path.stem))
        if path.stem == "SkinFrequencies":
            there["message"].n_pads = 3
        if path.stem == "ReplayState":
            there["message"].length = 1.0
        for name, _, _, example in table(PAGE, path.stem):
            of = name.strip("`")
            assert of in example, f"{path.stem}.{of}: {example} reads another field"
            eval(example.strip("`"), there)


def test_status_bits_of_the_page_are_those_of_the_message():
    text = (ROOT / "msg" / "SkinStress.msg").read_text()
    defined = dict(re.findall(r"^uint16 (\w+)=(\d+)", text, re.MULTILINE))
    shown = dict(re.findall(r"^\| `(\w+)` \| (\d+) \|", PAGE.read_text(), re.MULTILINE))
    assert shown == defined


@pytest.mark.parametrize("rows", [ctd.FrequencyRows, ctd.StressRows])
def test_table_of_rows_has_their_fields(rows):
    page = (ROOT / "docs" / "python.md").read_text()
    [cells] = re.findall(rf"^\| `{rows.__name__}` .*\n\|---.*\n((?:\|.*\n)+)", page, re.MULTILINE)
    first = [line.split(" | ")[0] for line in cells.splitlines()]
    assert re.findall(r"\w+", " ".join(first)) == [field.name for field in fields_of(rows)]


def test_recorded_messages_are_read_as_the_page_says(tmp_path, monkeypatch, capsys):
    make_bag(tmp_path / "run1", ROOT / "config" / "skin_demo.yaml", 2)
    monkeypatch.chdir(tmp_path)
    [program] = [block for block in blocks(PAGE, "python") if "rclpy" not in block]
    exec(compile(program, PAGE, "exec"), {})
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 16 and re.fullmatch(r"c05: \d+\.\d\d Hz on pad \+z-x", said[5])


def test_program_in_cpp_fits_the_messages(tmp_path):
    """Against the generated messages; with the real rclcpp where there is one."""
    compiler = shutil.which("c++")
    found = [Path(path) for path in os.environ["AMENT_PREFIX_PATH"].split(os.pathsep)]
    folders = [folder for path in found for folder in path.glob("include/*") if folder.is_dir()]
    if not any((folder / "rclcpp" / "rclcpp.hpp").is_file() for folder in folders):
        (tmp_path / "rclcpp").mkdir()
        (tmp_path / "rclcpp" / "rclcpp.hpp").write_text(RCLCPP)
        folders.append(tmp_path)
    [program] = blocks(PAGE, "cpp")
    (tmp_path / "listen.cpp").write_text(program)
    command = [compiler, "-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Werror"]
    includes = [f"-I{folder}" for folder in folders]
    done = subprocess.run(
        [*command, *includes, "listen.cpp"], cwd=tmp_path, text=True, capture_output=True
    )
    assert done.returncode == 0, done.stderr


def test_table_of_parameters_is_that_of_the_nodes():
    [section] = re.findall(r"(?s)\n(\| parameter .*?)\n\n", PARAMETERS.read_text())
    assert section.splitlines() == parameter_table()


def test_quoted_messages_are_those_of_the_package():
    """… on the page stands for a value, so the longest piece between two of them is looked up."""
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    symptoms = re.findall(r"^\| (?!you see)([^|]*`[^|]*) \|", page, re.MULTILINE)
    quoted = [text for cell in symptoms for text in re.findall(r"`([^`]+)`", cell) if " " in text]
    assert len(quoted) > 40
    files = [*ROOT.glob("cube_tensor_driver/**/*.py"), ROOT / "tools" / "environment.py"]
    said = {
        node.value
        for path in files
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    pieces = {text: max(text.split("…"), key=len) for text in quoted}
    unknown = [text for text, piece in pieces.items() if not any(piece in each for each in said)]
    assert not unknown


def test_computed_numbers_of_the_build_page_are_right():
    page = (ROOT / "docs" / "build.md").read_text()
    planar = planar_calibration()
    every_pad = make_estimator(planar.response, planar.noise, planar.modes)
    pressed = every_pad.matrix * planar.response[:, planar.modes.names.index("zz")]
    zz, zx = (100 * 0.01 * np.linalg.norm(pressed[COMPONENTS.index(name)]) for name in ("zz", "zx"))
    assert f"shear of {zx:.1f} % and σzz off by {zz:.1f} % of the pressure" in page
    assert f"shear of {100 * np.sin(np.radians(1)):.1f} % of σzz − σxx" in page

    def below(depth: float, radius: float) -> float:
        ball = contact.hertz(radius, (0.0, 0.0, -1.0), np.zeros(2))
        return contact.field(np.array([[0.0, 0.0, -depth]]), *ball, POISSONS_RATIO)[0][0, 2]

    deeper = {mm: 100 * (1 - below(4.1e-3, 1e-3 * mm) / below(4e-3, 1e-3 * mm)) for mm in (4, 8)}
    assert f"σzz −{deeper[4]:.1f} % under a contact of 4 mm radius, −{deeper[8]:.1f} %" in page
    foam, noise = 1.5 * 8.854e-12, FREQUENCY_NOISE * FOAM_MODULUS
    for area, thickness in ((0.8 * 0.8, 0.2), (0.8 * 4, 0.2), (0.8 * 4, 0.1)):
        pad = foam * 1e-3 * area / thickness
        small, large = 0.1e-12 / pad, 3e-12 / pad
        cells = f"{1e12 * pad:.2f} pF | β = {small:.2g}"
        assert cells in page and f"β = {large:.2g}, {noise * (1 + large):.0f} Pa" in page
