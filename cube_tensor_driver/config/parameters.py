"""Parameters of the nodes, as tables of plain data.

The nodes declare them, commands without ROS take some of them as options, and docs/parameters.md
lists them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from ..core.defaults import CONTACT_METHODS, CONTACT_PRESSURE, POISSONS_RATIO, SURFACE_DEPTH
from ..core.modes import STRESS
from .influence import influence_problem
from .port import port_problem

QUANTITIES = ("pressure", "shear", "gradient", *STRESS, "residual")
"""Names of the quantities that colours can show; `views.scene` draws them."""


class Parameter(NamedTuple):
    """A parameter of a node.

    Attributes:
        name: Its name.
        default: Its default, of the parameter's type.
        description: What `ros2 param describe` says.
        span: Lowest and highest value of a number.
        choices: Allowed texts, separated by commas.
        live: Whether it may change while the node is configured.
        minimum: Lowest value of a number other than 0.
        problem: Function that returns what is wrong with a text, or an empty text if nothing is.
    """

    name: str
    default: Any
    description: str
    span: tuple[float, float] | None = None
    choices: str = ""
    live: bool = False
    minimum: float | None = None
    problem: Callable[[str], str] | None = None


AUTOSTART = Parameter(
    "autostart", True, "Configure and activate at once; false waits for lifecycle transitions."
)
RELIABILITY = Parameter(
    "qos_reliability",
    "reliable",
    "Reliability of the batch topics.",
    choices="reliable, best_effort",
)
DRIVER = (
    AUTOSTART,
    Parameter("config", "", "Skin file (YAML)."),
    Parameter(
        "port",
        "",
        "Port instead of the one in the skin file, for a skin with one link.",
        problem=port_problem,
    ),
    Parameter(
        "port_directory",
        "",
        "Folder with the links' ports under the links' names: simulated hubs.",
    ),
    Parameter(
        "rate",
        0.0,
        "Samples per second to ask of the hubs; 0: as the skin file says.",
        span=(0.0, 10_000.0),
        live=True,
        minimum=0.1,
    ),
    Parameter(
        "publish_period",
        0.0,
        "Time that one message covers, s; 0: a message for each scan.",
        span=(0.0, 1.0),
    ),
    RELIABILITY,
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
        "Side of the face that wrenches and forces refer to, m; 0: the cube's own.",
        span=(0.0, 10.0),
    ),
    Parameter("forces", False, "Publish one force per cube on `forces`, as a point cloud."),
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
SKIN_SUBSCRIBER = (
    AUTOSTART,
    Parameter("rate", 20.0, "Maximum number of messages per second.", span=(0.1, 100.0)),
)
MARKERS = (
    *SKIN_SUBSCRIBER,
    Parameter("quantity", "pressure", "What the colours mean.", choices=", ".join(QUANTITIES)),
    Parameter(
        "range",
        0.0,
        "Top of the colours' range, SI; 0: it follows the values.",
        span=(0.0, 1e9),
    ),
    Parameter("crosses", False, "Draw the principal stresses of each cube as a cross."),
)
CONTACTS = (
    *SKIN_SUBSCRIBER,
    Parameter(
        "depth",
        SURFACE_DEPTH,
        "Distance from the cubes' centres to the skin's surface, m.",
        span=(1e-5, 1.0),
    ),
    Parameter(
        "least",
        CONTACT_PRESSURE,
        "Pressure at the cubes that counts as contact, Pa.",
        span=(0.0, 1e9),
    ),
    Parameter(
        "method",
        CONTACT_METHODS[0],
        "How contacts are found: from the pressure interpolated between the cubes, or from the "
        "surface's traction through the elastomer, which is published on `traction`, too.",
        choices=", ".join(CONTACT_METHODS),
    ),
    Parameter(
        "thickness",
        0.0,
        "Thickness of the elastomer over rigid ground, m, for the method inverse; 0: a half space.",
        span=(0.0, 1.0),
    ),
    Parameter(
        "poisson",
        POISSONS_RATIO,
        "Poisson's ratio of the elastomer, for the method inverse.",
        span=(0.0, 0.5),
    ),
    Parameter(
        "influence",
        "",
        "For the method inverse, what the pads measure of forces on the surface: the name of a "
        "shipped table, or a file of `./cube fem MODEL --surface`. Then depth, thickness and "
        "poisson are those of the table. Empty: cubes count as points.",
        problem=influence_problem,
    ),
)
