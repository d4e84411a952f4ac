# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The URDF (robot description) of a skin, by which it is attached to the URDF of a robot."""

from __future__ import annotations

from .skin import Skin

_ROBOT = """\
<?xml version="1.0"?>
<robot name="{name}">
  <link name="{parent}" />
  <material name="{name}_cube">
    <color rgba="0.35 0.38 0.42 1" />
  </material>
{cubes}</robot>
"""
"""Template of the URDF of a skin. A robot may carry several skins, whose materials must have
different names, so they begin with the name of the skin."""

_CUBE = """\
  <link name="{frame}">
    <visual>
      <geometry>
        <box size="{side:g} {side:g} {side:g}" />
      </geometry>
      <material name="{name}_cube" />
    </visual>
  </link>
  <joint name="{frame}_joint" type="fixed">
    <origin xyz="{xyz}" rpy="{rpy}" />
    <parent link="{parent}" />
    <child link="{frame}" />
  </joint>
"""
"""Template of the URDF of a cube: a link (rigid body) with a box of the size of the cube, and the
joint to the parent frame."""


def make_skin_urdf(skin: Skin) -> str:
    """Return the URDF of a skin as XML text.

    The root link has the name of the skin's parent frame. Each cube is a link with the name of the
    cube's frame, connected to the root by a fixed joint. Units are m and rad; rotations are about
    fixed axes, as in the skin file. Names need no escaping, as the schema of a skin file allows
    only letters, digits, _ and /. Source: the elements joint and link of the URDF specification.
    """
    cubes = [
        _CUBE.format(
            name=skin.name,
            frame=skin.make_frame_id(cube),
            parent=skin.parent_frame,
            side=2 * cube.calibration.half_side,
            xyz=_format(cube.xyz),
            rpy=_format(cube.rpy),
        )
        for cube in skin.cubes
    ]
    return _ROBOT.format(
        name=skin.name,
        parent=skin.parent_frame,
        cubes="".join(cubes),
    )


def _format(values: tuple[float, float, float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)
