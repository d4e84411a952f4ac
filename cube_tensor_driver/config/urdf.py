# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The URDF (robot description) of a skin, by which it is attached to the URDF of a robot."""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from .skin import Skin, SkinCube

CUBE_COLOUR = "0.35 0.38 0.42 1"
"""Colour of the cubes in a URDF: red, green, blue and opacity, each from 0 to 1."""


def make_skin_urdf(skin: Skin) -> str:
    """Return the URDF of a skin as XML text.

    The root link has the name of the skin's parent frame. Each cube is a link (rigid body) with the
    name of the cube's frame and a box of the cube's size, connected to the root by a fixed joint.
    Units are m and rad; rotations are about fixed axes, as in the skin file. Source: the elements
    joint and link of the URDF specification.
    """
    robot = Element("robot", name=skin.name)
    SubElement(robot, "link", name=skin.parent_frame)
    # A robot may carry several skins, and names of materials must differ within one URDF.
    material = f"{skin.name}_cube"
    SubElement(
        SubElement(robot, "material", name=material),
        "color",
        rgba=CUBE_COLOUR,
    )
    for cube in skin.cubes:
        _add_cube(
            robot,
            cube,
            skin.frame(cube),
            skin.parent_frame,
            material,
        )

    # The text is indented because users paste it into the URDF of their robot.
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _add_cube(
    robot: Element,
    cube: SkinCube,
    frame: str,
    parent: str,
    material: str,
) -> None:
    """Add the link of a cube to the URDF, and the joint that fixes it to the parent frame.

    Args:
        robot: The root element of the URDF, which is extended.
        cube: The cube.
        frame: Frame id of the cube, the name of the new link.
        parent: Frame id of the skin's parent frame.
        material: Name of the material (colour) of the box.
    """
    visual = SubElement(SubElement(robot, "link", name=frame), "visual")
    side = f"{2 * cube.calibration.half_side:g}"
    SubElement(SubElement(visual, "geometry"), "box", size=f"{side} {side} {side}")
    SubElement(visual, "material", name=material)

    joint = SubElement(
        robot,
        "joint",
        name=f"{frame}_joint",
        type="fixed",
    )
    SubElement(
        joint,
        "origin",
        xyz=_format(cube.xyz),
        rpy=_format(cube.rpy),
    )
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=frame)


def _format(values: tuple[float, float, float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)
