"""The package as a whole: what is installed, which way imports point, what is documented and
pinned."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from conftest import ROOT

PACKAGE = ROOT / "cube_tensor_driver"
# A folder may import those after it, never those before it.
FLOORS = [
    ["cli"],
    ["trials"],
    ["browser"],
    ["ros"],
    ["plot", "terminal"],
    ["processes"],
    ["simulation"],
    ["bags", "research"],
    ["device", "elastic", "config"],
    ["core"],
]
# Each heavy library in as few folders as it needs.
HOMES = {
    "rclpy": {"ros", "browser", "trials", "cli"},
    "serial": {"device"},
    "cobs": {"device", "simulation"},
    "yaml": {"config"},
    "jsonschema": {"config"},
    "rich": {"terminal", "trials", "cli"},
    "matplotlib": {"plot"},
    "rosbags": {"bags"},
    "pyarrow": {"bags"},
    "distributed": {"cli"},
    "skfem": {"elastic", "research"},
    "transforms3d": {"core"},
    "launch": {"ros"},
    "viser": {"browser"},
}


def imports(path: Path) -> set[str]:
    """Modules that a file imports anywhere, relative ones resolved."""
    here = ["cube_tensor_driver", *path.relative_to(PACKAGE).parts[:-1]]
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level + 1] if node.level else []
            found.add(".".join([*base, *([node.module] if node.module else [])]))
            if node.level and not node.module:
                found |= {".".join([*base, name.name]) for name in node.names}
    return found


def test_imports_point_one_way():
    floor = {name: number for number, names in enumerate(FLOORS) for name in names}
    for path in PACKAGE.rglob("*.py"):
        top = path.relative_to(PACKAGE).parts[0]
        if top == "__init__.py":
            continue
        for module in imports(path):
            parts = module.split(".")
            if (
                parts[0] == "cube_tensor_driver"
                and len(parts) > 1
                and parts[1] not in ("msg", "srv")
            ):
                target = parts[1] if parts[1] in floor else parts[1] + ".py"
                same = target == top
                assert same or floor[target] > floor[top], (
                    f"{path.relative_to(ROOT)} imports {module}"
                )


def test_heavy_libraries_stay_at_home():
    for path in PACKAGE.rglob("*.py"):
        for module in imports(path):
            home = HOMES.get(module.split(".")[0])
            if home is not None:
                assert path.relative_to(PACKAGE).parts[0] in home, (
                    f"{path.relative_to(ROOT)} imports {module}"
                )


def test_core_needs_numpy_and_nothing_else():
    script = (
        "import sys, pkgutil, importlib, cube_tensor_driver.core as core\n"
        "import numpy, numpy.random, transforms3d.euler\n"
        "before = set(sys.modules)\n"
        "for module in pkgutil.iter_modules(core.__path__): importlib.import_module(f'{core.__name__}.{module.name}')\n"
        "tops = {name.split('.')[0] for name in set(sys.modules) - before}\n"
        "print(*sorted(t for t in tops if t not in sys.stdlib_module_names))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert set(done.stdout.split()) <= {"cube_tensor_driver", "numpy", "transforms3d"}


def test_no_exit_assert_or_bare_except_in_the_package():
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            place = f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
            assert not isinstance(node, ast.Assert), f"{place}: assert as a guard"
            if isinstance(node, ast.ExceptHandler):
                assert node.type is not None, f"{place}: bare except"


def test_every_dependency_is_declared_and_pinned():
    keys = {
        "numpy": "python3-numpy",
        "serial": "python3-serial",
        "cobs": "python-cobs-pip",
        "yaml": "python3-yaml",
        "transforms3d": "python3-transforms3d",
        "jsonschema": "python3-jsonschema",
        "rich": "python3-rich",
        "scipy": "python3-scipy",
        "matplotlib": "python3-matplotlib",
        "psutil": "python3-psutil",
        "rosbags": "python3-rosbags-pip",
    }
    # rosdep has no key for these; the commands that need them say so where they are missing.
    without_key = {"skfem", "pyarrow", "viser", "distributed", "dask"}
    wheels = {"serial": "pyserial", "yaml": "pyyaml", "skfem": "scikit-fem"}
    # Parts of wheels that are named already.
    parts = {"mpl_toolkits": "matplotlib"}
    declared = {
        element.text
        for element in ElementTree.parse(ROOT / "package.xml").iter()
        if "depend" in element.tag
    }
    locked = set(
        re.findall(r"^([a-z0-9-]+)==", (ROOT / "tools/requirements.lock").read_text(), re.MULTILINE)
    )
    used = {module.split(".")[0] for path in PACKAGE.rglob("*.py") for module in imports(path)}
    for name in (
        {parts.get(name, name) for name in used} - sys.stdlib_module_names - {"cube_tensor_driver"}
    ):
        if name not in without_key:
            assert keys.get(name, name) in declared, (
                f"{name} is imported but package.xml does not name it"
            )
        if name in keys or name in without_key:
            assert wheels.get(name, name) in locked, (
                f"{name} is imported but requirements.lock does not pin it"
            )


def test_every_locked_wheel_has_a_hash():
    text = (ROOT / "tools/requirements.lock").read_text()
    for block in re.split(r"\n(?=[a-z])", text.strip()):
        assert "--hash=sha256:" in block, block.splitlines()[0]


def test_installed_package_has_module_and_messages(tmp_path):
    """From the install space alone, without the checkout on the path."""
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    import os

    elsewhere = [
        path for path in sys.path if path and Path(path).resolve() not in (ROOT, ROOT / "test")
    ]
    script = (
        "import cube_tensor_driver, cube_tensor_driver.core.pipeline, cube_tensor_driver.ros.driver\n"
        "from cube_tensor_driver.msg import SkinStress, StressTensorStamped\n"
        "from cube_tensor_driver.srv import Tare\n"
        "from cube_tensor_driver.config.skin import read_skin\n"
        "from cube_tensor_driver.config.package_data import package_data\n"
        "print(len(read_skin(package_data() / 'config' / 'skin_demo.yaml').cubes), cube_tensor_driver.__file__)"
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(elsewhere)}
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=env,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    count, file = done.stdout.split()
    assert count == "16" and not Path(file).is_relative_to(PACKAGE)


def test_messages_say_unit_and_unknown():
    """Every field of ours stands under a comment."""
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
