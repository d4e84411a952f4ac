"""The URDF of a skin, with which it is attached to a robot: one link per cube."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

from .skin import Skin, SkinCube


def skin_urdf(skin: Skin) -> str:
    """The text of the URDF.

    The link `parent_frame` is the root. Each cube is a link, named as the cube's frame and fixed to
    the root, with a box of the cube's size. Units m and rad; rotations about fixed axes (xyz, rpy),
    as in the skin file. Source: the joint and link elements of URDF.
    """
    robot = ElementTree.Element("robot", name=skin.name)
    ElementTree.SubElement(robot, "link", name=skin.parent_frame)
    material = f"{skin.name}_cube"
    colour = ElementTree.SubElement(robot, "material", name=material)
    ElementTree.SubElement(colour, "color", rgba="0.35 0.38 0.42 1")
    for cube in skin.cubes:
        _add_cube(robot, cube, skin.frame(cube), skin.parent_frame, material)
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _add_cube(
    robot: ElementTree.Element, cube: SkinCube, frame: str, parent: str, material: str
) -> None:
    link = ElementTree.SubElement(robot, "link", name=frame)
    visual = ElementTree.SubElement(link, "visual")
    geometry = ElementTree.SubElement(visual, "geometry")
    side = f"{2 * cube.calibration.half_side:g}"
    ElementTree.SubElement(geometry, "box", size=f"{side} {side} {side}")
    ElementTree.SubElement(visual, "material", name=material)

    joint = ElementTree.SubElement(robot, "joint", name=f"{frame}_joint", type="fixed")
    ElementTree.SubElement(joint, "origin", xyz=_numbers(cube.xyz), rpy=_numbers(cube.rpy))
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=frame)


def _numbers(values: tuple[float, float, float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)
