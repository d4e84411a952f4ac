"""The parameters of the nodes, as tables."""

from __future__ import annotations

from typing import Any, NamedTuple


class Parameter(NamedTuple):
    """A parameter: its default, what `ros2 param describe` says, and what it allows.

    span: lowest and highest value of a number; choices: of a text, separated by commas; live: it
    may change while the node is configured.
    """

    name: str
    default: Any
    description: str
    span: tuple[float, float] | None = None
    choices: str = ""
    live: bool = False


AUTOSTART = Parameter(
    "autostart", True, "Configure and activate at once; false waits for lifecycle transitions."
)
RELIABILITY = Parameter(
    "qos_reliability",
    "reliable",
    "Reliability of the batch topics.",
    choices="reliable, best_effort",
)
RECONSTRUCTION = (
    AUTOSTART,
    Parameter(
        "config",
        "",
        "Skin file (YAML), or a bag: then replayed frequencies give the recorded stress.",
    ),
    Parameter(
        "wrench_side",
        0.0,
        "Side of the face that wrenches refer to, m; 0: the cube's own.",
        span=(0.0, 10.0),
    ),
    Parameter(
        "publish_period",
        0.0,
        "The driver's parameter of this name, s; queue depths follow from it.",
        span=(0.0, 1.0),
    ),
    RELIABILITY,
    Parameter(
        "tare_duration",
        1.0,
        "Time that ~/tare averages unless the request says another, s.",
        span=(0.5, 10.0),
        live=True,
    ),
    Parameter(
        "tare_folder",
        "",
        "Where tares are kept, by uid; empty: ~/.ros/cube_tensor_driver/tare.",
    ),
    Parameter(
        "drift_time",
        0.0,
        "Time constant with which rest frequencies follow slow drift while nothing touches "
        "a cube, s; 0: never.",
        span=(0.0, 1e6),
        live=True,
    ),
)
