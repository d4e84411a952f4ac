"""A URDF of a skin: one link per cube, fixed to the skin's parent frame, so that it hangs on any
robot."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

from .skin import Skin


def skin_urdf(skin: Skin) -> str:
    """The URDF text: link `parent_frame` as root, per cube a link named as its frame with a box of
    the cube's size.

    Units m and rad, poses about fixed axes (xyz, rpy) as in the skin file. Source: URDF's joint and
    link elements.
    """
    robot = ElementTree.Element("robot", name=skin.name)
    ElementTree.SubElement(robot, "link", name=skin.parent_frame)
    material = ElementTree.SubElement(robot, "material", name=f"{skin.name}_cube")
    ElementTree.SubElement(material, "color", rgba="0.35 0.38 0.42 1")
    for cube in skin.cubes:
        frame = skin.frame(cube)
        link = ElementTree.SubElement(robot, "link", name=frame)
        visual = ElementTree.SubElement(link, "visual")
        side = f"{2 * cube.calibration.half_side:g}"
        ElementTree.SubElement(
            ElementTree.SubElement(visual, "geometry"), "box", size=f"{side} {side} {side}"
        )
        ElementTree.SubElement(visual, "material", name=f"{skin.name}_cube")
        joint = ElementTree.SubElement(robot, "joint", name=f"{frame}_joint", type="fixed")
        ElementTree.SubElement(joint, "origin", xyz=_numbers(cube.xyz), rpy=_numbers(cube.rpy))
        ElementTree.SubElement(joint, "parent", link=skin.parent_frame)
        ElementTree.SubElement(joint, "child", link=frame)
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _numbers(values: tuple[float, float, float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)
