# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""docs/messages.md, docs/troubleshooting.md and computed numbers of pages against the package."""

from __future__ import annotations

import ast
import importlib
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")
pytest.importorskip("skfem", reason="needs skfem: pip install scikit-fem")

from test_python_page import blocks

from conftest import ROOT
from cube_tensor_design.studies.pads_example import read_planar_calibration
from cube_tensor_driver.core.defaults import FOAM_MODULUS, FREQUENCY_NOISE, POISSONS_RATIO
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.mechanics import contact

PAGE = ROOT / "docs" / "messages.md"
INTERFACES = sorted([*ROOT.glob("msg/*.msg"), *ROOT.glob("srv/*.srv")])
ENTRIES = 900
"""Length of the arrays in a filled message: a multiple of all row widths."""
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


def filled(kind: Any) -> Any:
    """Return a message with entries in each of its arrays."""
    message = kind()
    for name, of in kind.get_fields_and_field_types().items():
        array = re.fullmatch(r"sequence<(?:(\w+)/)?(\w+)>", of)
        if array and array[1]:
            inner = getattr(importlib.import_module(f"{array[1]}.msg"), array[2])
            setattr(message, name, [filled(inner)] * ENTRIES)
        elif array:
            setattr(message, name, ["" if array[2] == "string" else 0] * ENTRIES)
    return message


@pytest.mark.parametrize("path", INTERFACES, ids=lambda path: path.stem)
def test_every_field_of_a_message_has_a_comment_of_whole_sentences(path):
    lines = path.read_text().splitlines()
    for before, line in zip(["", *lines], lines, strict=False):
        if line and line != "---" and "=" not in line and not line.startswith("#"):
            assert re.search(r"^# .*\.$", before), f"{path.name}: {line}"


def test_examples_of_the_page_read_messages():
    messages = importlib.import_module("cube_tensor_driver.msg")
    frequencies = filled(messages.SkinFrequencies)
    frequencies.n_pads = 3
    there = {"np": np, "row": 1, "pad": 2, "info": filled(messages.SkinInfo)}
    introduction = PAGE.read_text().split("\n## ")[0]
    examples = re.findall(r"^ {4}(\w+ = .*)", introduction, re.MULTILINE)
    assert len(examples) == 7
    for example in examples:
        message = frequencies if "n_pads" in example else filled(messages.SkinStress)
        exec(example, there | {"message": message})


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


def test_quoted_messages_are_those_of_the_package():
    """… on the page stands for a value, so the longest piece between two of them is looked up."""
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    symptoms = re.findall(r"^\| (?!you see)([^|]*`[^|]*) \|", page, re.MULTILINE)
    quoted = [text for cell in symptoms for text in re.findall(r"`([^`]+)`", cell) if " " in text]
    assert len(quoted) > 10
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
    planar = read_planar_calibration()
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
