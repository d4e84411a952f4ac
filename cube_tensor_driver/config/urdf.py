"""The URDF of a skin, with which it is attached to a robot: one link per cube."""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from .skin import Skin, SkinCube

CUBE_COLOUR = "0.35 0.38 0.42 1"
"""Colour of the cubes: red, green, blue and opacity, from 0 to 1."""


def skin_urdf(skin: Skin) -> str:
    """Return the text of the URDF of a skin.

    The link `parent_frame` is the root. Each cube is a link that is named as the cube's frame and
    fixed to the root, with a box of the cube's size. Units are m and rad; rotations are about fixed
    axes, as in the skin file. Source: the elements joint and link of URDF.
    """
    robot = Element("robot", name=skin.name)
    SubElement(robot, "link", name=skin.parent_frame)
    # Materials of several skins on one robot must not have one name.
    material = f"{skin.name}_cube"
    SubElement(SubElement(robot, "material", name=material), "color", rgba=CUBE_COLOUR)
    for cube in skin.cubes:
        _add_cube(robot, cube, skin.frame(cube), skin.parent_frame, material)

    # People paste it into the URDF of their robot.
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _add_cube(
    robot: Element,
    cube: SkinCube,
    frame: str,
    parent: str,
    material: str,
) -> None:
    """Add the link of a cube, and the joint that fixes it to the parent frame."""
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
