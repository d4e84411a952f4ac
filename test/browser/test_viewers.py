# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The live table; and the set-ups for RViz and Foxglove. These programs are not installed here, so
the tests check that every name in the set-ups is one that the programs' sources read.

Names from ros2/rviz, branch jazzy (14.1): plugins_description.xml, panel_factory.cpp and the
constructors of displays and properties; from Lichtblick (Foxglove Studio's open sources), March
2025: the panels' index and config types.
"""

from __future__ import annotations

import io
import json

import numpy as np
import pytest

from conftest import ROOT
from cube_tensor_driver.config.rviz import make_rviz_view
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.views.scene import QUANTITIES, choose_colours

yaml = pytest.importorskip("yaml")

DISPLAY = {"Class", "Name", "Enabled"}
QUALITY = {
    "Depth": range(1, 1000),
    "History Policy": ("System Default", "Keep Last", "Keep All"),
    "Reliability Policy": ("System Default", "Reliable", "Best Effort"),
    "Durability Policy": ("System Default", "Transient Local", "Volatile"),
}
DISPLAYS = {
    "Grid": {
        "Reference Frame",
        "Plane Cell Count",
        "Normal Cell Count",
        "Cell Size",
        "Line Style",
        "Color",
        "Alpha",
        "Plane",
        "Offset",
    },
    "RobotModel": {
        "Visual Enabled",
        "Collision Enabled",
        "Mass Properties",
        "Update Interval",
        "Alpha",
        "Description Source",
        "Description File",
        "Description Topic",
        "TF Prefix",
    },
    "MarkerArray": {"Namespaces", "Topic"},
    "Wrench": {
        "Accept NaN Values",
        "Force Color",
        "Torque Color",
        "Alpha",
        "Force Arrow Scale",
        "Torque Arrow Scale",
        "Arrow Width",
        "History Length",
        "Topic",
    },
    "PointCloud2": {
        "Style",
        "Size (m)",
        "Position Transformer",
        "Color Transformer",
        "Channel Name",
        "Autocompute Intensity Bounds",
        "Min Intensity",
        "Max Intensity",
        "Use rainbow",
        "Min Color",
        "Max Color",
        "Topic",
    },
    "TF": {
        "Show Names",
        "Show Axes",
        "Show Arrows",
        "Marker Scale",
        "Update Interval",
        "Frame Timeout",
        "Frames",
    },
}
TOOLS = {
    "Interact",
    "MoveCamera",
    "Select",
    "FocusCamera",
    "Measure",
    "SetInitialPose",
    "SetGoal",
    "PublishPoint",
}
PANELS = {"Displays", "Help", "Selection", "Time", "Tool Properties", "Transformation", "Views"}
ORBIT = {
    "Class",
    "Name",
    "Distance",
    "Focal Shape Size",
    "Focal Shape Fixed Size",
    "Yaw",
    "Pitch",
    "Focal Point",
    "Near Clip Distance",
    "Target Frame",
    "Invert Z Axis",
    "Enable Stereo Rendering",
}

PLOT = {
    "foxglovePanelTitle",
    "paths",
    "minXValue",
    "maxXValue",
    "minYValue",
    "maxYValue",
    "showLegend",
    "legendDisplay",
    "showPlotValuesInLegend",
    "showXAxisLabels",
    "showYAxisLabels",
    "isSynced",
    "xAxisVal",
    "xAxisPath",
    "followingViewWidth",
    "sidebarDimension",
}
FOXGLOVE = {
    "3D": {
        "cameraState",
        "followTf",
        "followMode",
        "scene",
        "publish",
        "transforms",
        "topics",
        "layers",
        "imageMode",
    },
    "Plot": PLOT,
    "DiagnosticSummary": {
        "topicToRender",
        "minLevel",
        "pinnedIds",
        "hardwareIdFilter",
        "sortByLevel",
    },
}
CAMERA = {
    "distance",
    "perspective",
    "phi",
    "target",
    "targetOffset",
    "targetOrientation",
    "thetaOffset",
    "fovy",
    "near",
    "far",
}
GRID = {
    "visible",
    "frameLocked",
    "label",
    "instanceId",
    "layerId",
    "frameId",
    "size",
    "divisions",
    "lineWidth",
    "color",
    "position",
    "rotation",
}
PATH = {"value", "enabled", "color", "label", "timestampMethod", "showLine", "lineSize"}


def topic_of(display: dict) -> dict | None:
    return display.get("Topic") or display.get("Description Topic")


def test_rviz_reads_every_name_of_ours():
    rviz = yaml.safe_load((ROOT / "rviz" / "skin.rviz").read_text())
    assert {panel["Class"] for panel in rviz["Panels"]} <= {
        f"rviz_common/{name}" for name in PANELS
    }
    manager = rviz["Visualization Manager"]
    assert set(manager["Global Options"]) <= {"Fixed Frame", "Background Color", "Frame Rate"}
    for display in manager["Displays"]:
        package, name = display["Class"].split("/")
        assert package == "rviz_default_plugins" and set(display) - DISPLAY <= DISPLAYS[name], (
            display["Name"]
        )
        topic = topic_of(display)
        if topic is not None:
            assert set(topic) == {"Value", *QUALITY}
            assert all(topic[key] in allowed for key, allowed in QUALITY.items())
    assert {tool["Class"] for tool in manager["Tools"]} <= {
        f"rviz_default_plugins/{name}" for name in TOOLS
    }
    assert manager["Transformation"]["Current"]["Class"] == "rviz_default_plugins/TF"
    view = manager["Views"]["Current"]
    assert view["Class"] == "rviz_default_plugins/Orbit" and set(view) <= ORBIT


def test_rviz_gets_the_frame_a_wrench_and_a_view_of_any_skin():
    skin = read_skin(ROOT / "config" / "examples" / "sole.yaml")
    manager = make_rviz_view(skin)["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == skin.parent_frame
    displays = {display["Name"]: display for display in manager["Displays"]}
    topic = displays["Wrench"]["Topic"]["Value"]
    assert topic in {f"cubes/{cube.name}/wrench" for cube in skin.cubes}
    camera = manager["Views"]["Current"]
    centre = np.array([camera["Focal Point"][axis] for axis in "XYZ"])
    radius = np.linalg.norm(np.array([cube.xyz for cube in skin.cubes]) - centre, axis=1).max()
    # RViz's camera sees 45 degrees: half of that reaches 0.41 of the distance.
    assert radius < 0.41 * camera["Distance"] < 2 * radius


def test_cubes_at_rest_and_arrows_stand_out_from_the_ground_of_rviz():
    rviz = yaml.safe_load((ROOT / "rviz" / "skin.rviz").read_text())
    ground = rviz["Visualization Manager"]["Global Options"]["Background Color"]
    grey = np.array([float(part) for part in ground.split(";")]) / 255
    at_rest = choose_colours(QUANTITIES["pressure"], np.zeros(1), 1.0)[0]
    for colour in (at_rest, np.ones(3)):
        assert abs((colour - grey) @ [0.299, 0.587, 0.114]) > 0.2


def test_rviz_shows_our_topics_as_they_are_offered():
    """A latched topic needs a latched subscription, and a reliable subscription a reliable
    publisher."""
    rviz = yaml.safe_load((ROOT / "rviz" / "skin.rviz").read_text())
    displays = {
        display["Class"].split("/")[1]: display
        for display in rviz["Visualization Manager"]["Displays"]
    }
    assert topic_of(displays["MarkerArray"])["Value"] == "markers"
    model = topic_of(displays["RobotModel"])
    assert model["Value"] == "skin_description" and model["Durability Policy"] == "Transient Local"
    wrench = displays["Wrench"]
    assert (
        wrench["Topic"]["Value"] == "cubes/c05/wrench"
        and wrench["Topic"]["Reliability Policy"] == "Best Effort"
    )
    assert wrench["Accept NaN Values"] is False
    # RViz draws no arrow that is shorter than its width. On a cube 4 mm wide, 10 kPa must give an
    # arrow, and 40 kPa must not give one that is too long.
    force = np.array([10e3, 40e3]) * 0.004**2
    short, long = force * wrench["Force Arrow Scale"]
    assert wrench["Enabled"] and wrench["Arrow Width"] < short and long < 0.06
    assert rviz["Visualization Manager"]["Global Options"]["Fixed Frame"] == "skin_base"
    surface = displays["PointCloud2"]
    assert topic_of(surface)["Value"] == "traction" and surface["Channel Name"] == "pressure"


def test_foxglove_reads_every_name_of_ours():
    layout = json.loads((ROOT / "config" / "foxglove_skin.json").read_text())
    assert set(layout) <= {
        "configById",
        "layout",
        "globalVariables",
        "playbackConfig",
        "userNodes",
        "version",
    }
    panels = layout["configById"]
    for name, panel in panels.items():
        kind = name.partition("!")[0]
        assert set(panel) <= FOXGLOVE[kind], name
        for path in panel.get("paths", []):
            assert set(path) <= PATH and path["timestampMethod"] in ("receiveTime", "headerStamp")
    (scene,) = (panel for name, panel in panels.items() if name.startswith("3D!"))
    assert set(scene["cameraState"]) <= CAMERA and set(scene["layers"]["grid"]) <= GRID
    assert scene["followMode"] in ("follow-pose", "follow-position", "follow-none")
    assert scene["topics"]["/markers"]["visible"] and scene["followTf"] == "skin_base"
    # The axes of a frame are 1 m long by default, and a skin has a frame in each cube.
    assert scene["scene"]["transforms"]["axisScale"] < 0.004

    def leaves(node: object) -> list[str]:
        return (
            [node] if isinstance(node, str) else [*leaves(node["first"]), *leaves(node["second"])]
        )

    assert sorted(leaves(layout["layout"])) == sorted(panels)


def test_what_foxglove_plots_are_fields_of_our_messages():
    pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
    from geometry_msgs.msg import WrenchStamped

    from cube_tensor_driver.msg import StressTensorStamped

    kinds = {"stress": StressTensorStamped, "wrench": WrenchStamped}
    layout = json.loads((ROOT / "config" / "foxglove_skin.json").read_text())
    paths = [
        path["value"] for panel in layout["configById"].values() for path in panel.get("paths", [])
    ]
    assert paths
    for path in paths:
        topic, *fields = path.split(".")
        value = kinds[topic.rpartition("/")[2]]()
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, float)


def live_table(width: int) -> tuple[str, list[str]]:
    """The table of sixteen planar cubes as a terminal of this width shows it, and their rows."""
    console = pytest.importorskip("rich.console", reason="needs rich: run this with ./cube test")
    from cube_tensor_driver.config.package_data import find_package_data
    from cube_tensor_driver.config.skin import read_skin
    from cube_tensor_driver.core.rows import StressRows
    from cube_tensor_driver.views.terminal.live_table import LiveTable

    skin = read_skin(find_package_data() / "config" / "skin_demo.yaml")
    n = len(skin.cubes)
    stress, gradient = np.full((n, 6), np.nan, np.float32), np.full((n, 9), np.nan, np.float32)
    stress[:, [0, 2, 4]], gradient[:, [6, 8]] = -123e3, -12e6
    table = LiveTable(skin, show=False)
    table.update(StressRows.from_values(np.arange(n), stress, gradient, residual=1.0))
    shown = console.Console(width=width, record=True, file=io.StringIO())
    shown.print(table.draw(n, width))
    text = shown.export_text()
    rows = [line for line in text.splitlines() if any(name in line for name in skin.names)]
    assert len(rows) == n
    return text, rows


@pytest.mark.parametrize("width", [80, 120])
def test_the_live_table_of_planar_cubes_fits_into(width):
    text, rows = live_table(width)
    assert "…" not in text
    for word in ("pressure", "∂zz/∂z", "residual", "Hz", "state"):
        assert word in text
    assert all(row.count("-123.00") == 3 and row.count("-12.00") == 2 for row in rows)
    assert all("1.00" in row and "ok" in row for row in rows)


@pytest.mark.parametrize("width", [60, 40])
def test_the_live_table_of_a_narrow_terminal_keeps_the_state(width):
    text, rows = live_table(width)
    assert "…" not in text and all(len(line) <= width for line in text.splitlines())
    assert "state" in text and all("ok" in row and "1.00" in row for row in rows)
    assert "too narrow for pressure, " in " ".join(text.split())
    assert all("-123.00" in row for row in rows)
