# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The package as a whole: what is installed, which way imports point, what is documented and
pinned."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from importlib.util import resolve_name
from pathlib import Path

import pytest

from conftest import ROOT

PACKAGE = ROOT / "cube_tensor_driver"
FLOORS = [
    ["cli"],
    ["demo"],
    ["browser"],
    ["ros"],
    ["views"],
    ["calibrate", "lerobot"],
    ["bags", "simulation"],
    ["messages"],
    ["touch"],
    ["device", "mechanics"],
    ["processes"],
    ["config"],
    ["core"],
]
"""Folders of the driver. One may import those below it in this list, none above or beside it."""
PRODUCTS = {
    "cube_tensor_driver": set(),
    "cube_tensor_design": {"cube_tensor_driver"},
    "cube_tensor_hub": {"cube_tensor_driver"},
    "lerobot_camera_cube": {"cube_tensor_driver"},
    "workshop": {"cube_tensor_driver", "cube_tensor_design", "cube_tensor_hub"},
}
"""Package -> the other packages of the repository that it may import."""
HOMES = {
    "rclpy": {"ros", "browser", "demo", "workshop"},
    "serial": {"device"},
    "yaml": {"config"},
    "jsonschema": {"config"},
    "rich": {"cli", "views", "cube_tensor_design", "cube_tensor_hub", "workshop"},
    "psutil": {"demo", "cube_tensor_design", "workshop"},
    "matplotlib": {"views", "cube_tensor_design", "workshop"},
    "scipy": {"mechanics", "touch", "views", "browser", "cube_tensor_design"},
    "rosbags": {"bags", "lerobot"},
    "mcap": {"bags"},
    "pyarrow": {"bags", "lerobot"},
    "PIL": {"lerobot"},
    "zarr": {"bags"},
    "skfem": {"cube_tensor_design"},
    "transforms3d": {"core"},
    "launch": {"ros"},
    "viser": {"browser", "workshop"},
    "mujoco": {"simulation"},
    "lerobot": {"lerobot_camera_cube"},
}
"""Each heavy library -> the few folders of the driver, and the other packages, that import it."""


def python(script: str, folder: Path = ROOT, **environment: str) -> str:
    """What a Python of its own prints, run in that folder."""
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, **environment},
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def imports(path: Path) -> set[str]:
    """What a file imports anywhere, by its whole name."""
    package = ".".join(path.relative_to(ROOT).parent.parts)
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), package)
            found |= {f"{base}.{name.name}" for name in node.names}
    return found


def all_imports() -> Iterator[tuple[str, str, Path]]:
    """(folder of the driver or other package, what is imported, file) of every import."""
    for package in PRODUCTS:
        for path in (ROOT / package).rglob("*.py"):
            parts = path.relative_to(ROOT).parts
            room = parts[1] if package == PACKAGE.name else package
            for module in imports(path):
                yield room, module, path


def test_imports_point_one_way():
    floor = {name: number for number, names in enumerate(FLOORS) for name in names}
    assert set(floor) == {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    for room, module, path in all_imports():
        top, _, rest = module.partition(".")
        package = path.relative_to(ROOT).parts[0]
        if top in PRODUCTS and top != package:
            assert top in PRODUCTS[package], f"{path} imports {module}"
        other = rest.split(".")[0]
        if top == package == PACKAGE.name and room in floor and other in floor and other != room:
            assert floor[other] > floor[room], f"{path} imports {module}"


def test_each_class_has_a_name_of_its_own():
    modules = {}
    for package in PRODUCTS:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ClassDef):
                    modules.setdefault(node.name, set()).add(path)
    assert not {name: paths for name, paths in modules.items() if len(paths) > 1}


def test_only_the_border_to_ros_has_values_of_any_type():
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            is_any = isinstance(node, ast.alias) and node.name == "Any"
            assert not is_any or "ros" in path.relative_to(PACKAGE).parts, path


def test_heavy_libraries_stay_at_home():
    for room, module, path in all_imports():
        homes = HOMES.get(module.split(".")[0], {room})
        assert room in homes, f"{path} imports {module}"


def test_core_needs_numpy_and_nothing_else():
    """transforms3d, which is numpy only too, for rotations."""
    script = """
import importlib, pkgutil, sys
import numpy, transforms3d.euler, cube_tensor_driver.core as core
before = set(sys.modules)
for module in pkgutil.walk_packages(core.__path__, f"{core.__name__}."):
    importlib.import_module(module.name)
tops = {name.split(".")[0] for name in set(sys.modules) - before}
print(*tops - sys.stdlib_module_names)
"""
    assert set(python(script).split()) <= {"cube_tensor_driver", "numpy", "transforms3d"}


# Module -> wheel -> rosdep key, where the names differ. package.xml does not name the last ones:
# rosdep has no key for them, or only commands that display something need them. Those commands say
# what is missing.
WHEELS = {
    "serial": "pyserial",
    "yaml": "pyyaml",
    "skfem": "scikit-fem",
    "mpl_toolkits": "matplotlib",
    "PIL": "pillow",
}
KEYS = {
    "pyserial": "python3-serial",
    "pyyaml": "python3-yaml",
} | dict.fromkeys(
    (
        "rich",
        "psutil",
        "matplotlib",
        "pillow",
        "rosbags",
        "scikit-fem",
        "pyarrow",
        "viser",
        "mujoco",
        "distributed",
        "dask",
        "mcap",
        "zstandard",
        "selenium",
        "msgspec",
        "websockets",
    )
)


# Who exports to Zarr installs it; all others do without.
NOT_PINNED = {"zarr"}
# It has a pyproject.toml of its own, and whoever installs it has lerobot.
PLUGIN = "lerobot_camera_cube"


def test_every_dependency_is_declared_and_pinned():
    """What comes from ROS in package.xml, wheels there, in pyproject.toml and in the lock."""
    tomllib = pytest.importorskip("tomllib", reason="needs tomllib of Python 3.11")
    of_ros = {
        element.text
        for element in ElementTree.parse(ROOT / "package.xml").iter()
        if "depend" in element.tag
    }
    of_ros |= {name.removesuffix("_py") for name in of_ros}  # tf2_ros_py has the module tf2_ros
    locks = [path.read_text() for path in (ROOT / "tools").glob("requirements-*.lock")]
    pinned = [set(re.findall(r"^([a-z0-9-]+)==", lock, re.MULTILINE)) for lock in locks]
    locked = set.intersection(*pinned)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    by_pip = list(project["dependencies"])
    for extra in project["optional-dependencies"].values():
        by_pip += extra
    of_pip = {re.match(r"[a-z0-9-]+", requirement)[0] for requirement in by_pip}
    used = {module.split(".")[0] for room, module, _ in all_imports() if room != PLUGIN}
    for module in used - sys.stdlib_module_names - set(PRODUCTS) - of_ros:
        wheel = WHEELS.get(module, module)
        key = KEYS.get(wheel, f"python3-{wheel}")
        if wheel not in NOT_PINNED:
            assert key is None or key in of_ros, f"package.xml does not name {key}"
            assert wheel in locked, f"a lock file does not pin {wheel}"
        assert wheel in of_pip, f"pyproject.toml does not name {wheel}"


USES_ITS_DATA = """
import cube_tensor_driver, cube_tensor_driver.core.pipeline
from cube_tensor_driver.config.calibration import read_calibration
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
print(cube_tensor_driver.__file__)
print(find_package_data())
print(len(read_skin(find_package_data() / "config" / "skin_demo.yaml").cubes))
from cube_tensor_driver.device.wire.native import wire
print(wire and wire.__file__)
"""


def test_installed_by_colcon_it_has_module_and_messages(tmp_path):
    """From the install space alone, without the checkout on the path."""
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    elsewhere = [
        path for path in sys.path if path and Path(path).resolve() not in (ROOT, ROOT / "test")
    ]
    script = (
        "import cube_tensor_driver.ros.nodes.driver\n"
        "from cube_tensor_driver.msg import SkinStress, StressTensorStamped\n"
        "from cube_tensor_driver.srv import Tare\n"
    )
    said = python(script + USES_ITS_DATA, tmp_path, PYTHONPATH=os.pathsep.join(elsewhere))
    file, _, cubes, wire = said.splitlines()
    assert cubes == "16" and not Path(file).is_relative_to(PACKAGE)
    assert Path(wire).parent == Path(file).parent and Path(wire).name == "_wire.abi3.so"


def test_installed_by_pip_it_finds_its_data_and_the_wire_in_c(tmp_path):
    """All of config/, launch/, msg/, rviz/ and srv/ is there, and found where it was installed."""
    said = python(USES_ITS_DATA, tmp_path, PYTHONPATH=str(installed_by_pip(tmp_path)))
    file, found, cubes, wire = said.splitlines()
    prefix = tmp_path / "prefix"
    assert Path(file).is_relative_to(prefix) and cubes == "16"
    assert Path(found) == prefix / "share" / PACKAGE.name
    assert Path(wire).parent == Path(file).parent and Path(wire).name == "_wire.abi3.so"
    assert Path(file).with_name("py.typed").is_file()
    for name in DATA:
        assert listing(Path(found, name)) == listing(tmp_path / "source" / name)


def test_installed_by_pip_without_a_compiler_it_decodes_in_python(tmp_path):
    site = installed_by_pip(tmp_path, CC="no_such_compiler")
    *_, cubes, wire = python(USES_ITS_DATA, tmp_path, PYTHONPATH=str(site)).splitlines()
    assert (cubes, wire) == ("16", "None")


DATA = ("config", "launch", "msg", "rviz", "srv")


def installed_by_pip(tmp_path: Path, **variables: str) -> Path:
    """Install a copy of the sources below tmp_path/prefix; the folder for PYTHONPATH."""
    source, prefix = tmp_path / "source", tmp_path / "prefix"
    source.mkdir()
    for name in ("pyproject.toml", "package.xml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in (PACKAGE.name, "cube_tensor_design", "cube_tensor_hub", "native", *DATA):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    pip += ["--no-compile", "--no-build-isolation", "--disable-pip-version-check"]
    environment = {**os.environ, "PYTHONPATH": "", "PIP_ROOT_USER_ACTION": "ignore", **variables}
    subprocess.run(
        [*pip, "--ignore-installed", "--prefix", prefix, source], check=True, env=environment
    )
    (site,) = prefix.glob("**/cube_tensor_driver/core")
    return site.parents[1]


def listing(folder: Path) -> list[Path]:
    return sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())


def test_version_stands_in_both_files_alike():
    tree = ElementTree.parse(ROOT / "package.xml")
    project = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert project and project[1] == tree.findtext("version")


def test_importing_the_package_imports_nothing_heavy():
    """So that it takes hardly longer than numpy; python -X importtime tells what takes how long."""
    heavy = {
        "rclpy",
        "scipy",
        "matplotlib",
        "rosbags",
        "pyarrow",
        "viser",
        "rich",
        "skfem",
        "psutil",
        "mujoco",
    }
    loaded = python("import sys, cube_tensor_driver; print(*sys.modules)").split()
    assert not heavy & set(loaded)


def test_every_field_of_a_message_stands_under_a_comment():
    for path in [*ROOT.glob("msg/*.msg"), *ROOT.glob("srv/*.srv")]:
        comment = False
        for line in path.read_text().splitlines():
            if line.startswith("#"):
                comment = True
            elif re.match(r"[a-z]\S* [a-z_]+", line):
                assert comment or path.name == "StressTensorStamped.msg", (
                    f"{path.name}: {line} has no comment"
                )
            elif not line.strip():
                comment = False


def test_every_source_file_names_its_license():
    folders = [*PRODUCTS, "firmware", "launch", "native", "scripts", "test", "tools"]
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    source = [
        path
        for path in files
        if (path.suffix in (".py", ".c", ".h") and path.stat().st_size)
        or path.parent.name == "scripts"
    ]
    assert len(source) > 400
    line = "SPDX-License-Identifier: Apache-2.0"
    assert not [path for path in source if line not in path.read_text()[:200]]
