# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A release to apt: bloom makes the Debian files of this package from package.xml."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest

from conftest import ROOT

# rosdep keys of rosdistro that Ubuntu 22.04 and 24.04 have under the same name, from apt.
UBUNTU = (
    "python3-dev",
    "python3-hypothesis",
    "python3-jsonschema",
    "python3-numpy",
    "python3-pytest",
    "python3-scipy",
    "python3-serial",
    "python3-transforms3d",
    "python3-yaml",
)
# Packages that Humble, Jazzy, Kilted and Lyrical have released.
ROS = (
    "ament_cmake",
    "ament_cmake_pytest",
    "ament_cmake_python",
    "ament_index_python",
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "launch",
    "launch_ros",
    "lifecycle_msgs",
    "rcl_interfaces",
    "rclpy",
    "ros2bag",
    "rosbag2_storage_mcap",
    "rosgraph_msgs",
    "rosidl_default_generators",
    "rosidl_default_runtime",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "visualization_msgs",
    "tf2_ros_py",
)
UBUNTU_OF = {"humble": "jammy", "jazzy": "noble", "kilted": "noble", "lyrical": "resolute"}

needs_bloom = pytest.mark.skipif(
    not (shutil.which("bloom-generate") and shutil.which("rosdep")),
    reason="needs bloom-generate and rosdep: pipx install --include-deps bloom",
)


def dependencies() -> set[str]:
    """Return the rosdep keys that package.xml names."""
    elements = ElementTree.parse(ROOT / "package.xml").getroot()
    return {element.text for element in elements if element.tag.endswith("depend")}


def test_every_dependency_has_a_rosdep_key():
    assert dependencies() <= {*UBUNTU, *ROS}


def test_package_xml_is_in_order():
    """As REP 149 says: catkin_pkg warns of what the build farm warns of."""
    package = pytest.importorskip("catkin_pkg.package", reason="needs catkin_pkg")
    warnings: list[str] = []
    assert package.parse_package(str(ROOT / "package.xml"), warnings=warnings).package_format == 3
    assert warnings == []


@pytest.fixture(scope="module")
def farm(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a rosdep that knows UBUNTU and ROS, without a network."""
    home = tmp_path_factory.mktemp("farm")
    sources = home / "sources"
    sources.mkdir()
    keys = home / "keys.yaml"
    keys.write_text("".join(f"{key}: {{ubuntu: [{key}]}}\n" for key in UBUNTU))
    (sources / "20.list").write_text(f"yaml {keys.as_uri()}\n")
    index = ["%YAML 1.1", "---", "distributions:"]
    for distro, ubuntu in UBUNTU_OF.items():
        index.append(
            f"  {distro}: {{distribution: [{distro}.yaml], distribution_status: active,"
            " distribution_type: ros2, python_version: 3}"
        )
        (home / f"{distro}.yaml").write_text(
            "%YAML 1.1\n---\n"
            f"release_platforms: {{ubuntu: [{ubuntu}]}}\n"
            f"repositories: {{ros: {{release: {{packages: [{', '.join(ROS)}], version: 1.0.0-1,"
            " tags: {release: none}, url: none}}}\n"
            "type: distribution\nversion: 2\n"
        )
    (home / "index.yaml").write_text("\n".join([*index, "type: index", "version: 4", ""]))
    environment = {name: os.environ[name] for name in ("PATH", "LANG") if name in os.environ} | {
        "HOME": str(home),
        "ROS_HOME": str(home),
        "ROSDEP_SOURCE_PATH": str(sources),
        "ROSDISTRO_INDEX_URL": (home / "index.yaml").as_uri(),
    }
    subprocess.run(["rosdep", "update"], env=environment, check=True, capture_output=True)
    return environment


@needs_bloom
@pytest.mark.parametrize("distro", UBUNTU_OF)
def test_bloom_makes_the_debian_files(farm, tmp_path, distro):
    """They ask apt for all that package.xml names, and say what is new."""
    for name in ("package.xml", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path)
    version = ElementTree.parse(ROOT / "package.xml").findtext("version")
    heading = f"{version} (2026-01-01)"
    changes = (ROOT / "CHANGELOG.rst").read_text()
    changes = changes.replace("Forthcoming\n-----------", f"{heading}\n{'-' * len(heading)}")
    (tmp_path / "CHANGELOG.rst").write_text(changes)

    def debian(name: str) -> str:
        return Path(tmp_path, "debian", name).read_text()

    done = subprocess.run(
        [
            *("bloom-generate", "rosdebian", "--ros-distro", distro),
            *("--os-name", "ubuntu", "--os-version", UBUNTU_OF[distro]),
        ],
        env=farm,
        cwd=tmp_path,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    asked = set(re.findall(r"[a-z][a-z0-9-]+", debian("control")))
    named = {
        f"ros-{distro}-{key.replace('_', '-')}" if key in ROS else key for key in dependencies()
    }
    assert named <= asked
    assert debian("changelog").startswith(
        f"ros-{distro}-cube-tensor-driver ({version}-0{UBUNTU_OF[distro]})"
    )
    assert "no changelog" not in debian("changelog")
