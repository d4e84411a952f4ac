# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What one scan puts on the page: a pure function of the scan and of what the user has chosen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ..config.skin import Elastomer
from ..core.calibration import Calibration
from ..core.defaults import SURFACE_DEPTH
from ..core.modes import COMPONENTS
from ..core.poses import CubePoses
from ..touch.surface import Surface
from ..views.scene import QUANTITIES, Quantity, Ranges
from . import markup
from .charts import GROUPS, Chart, make_chart_properties
from .colouring import Colouring
from .history import History
from .scan import Scan
from .scene_3d import Scene, Update
from .surface_field import DEVIATION, FieldModel

MAX_SURFACE_POINTS = 5000
"""Approximate maximum of the number of points of the skin's surface at which the field (pressure
and shear between the cubes) is drawn."""

MAX_POINTS_PER_SIDE = 12
"""Maximum number of grid points along one side of the square part of the skin's surface around a
cube."""


class ShownSkin:
    """The skin that is shown, with everything that the pages of all browsers share.

    Attributes:
        name: Name of the skin.
        names: Names of its cubes.
        surface: Grid of points around the cubes at which the field (pressure and shear) is drawn.
        field: Computes the field at these points.
        scene: The skin in 3-D.
    """

    def __init__(
        self,
        name: str,
        names: Sequence[str],
        poses: CubePoses,
        calibrations: Sequence[Calibration],
        elastomer: Elastomer | None,
    ) -> None:
        """Prepare the points of the field and the 3-D view of the skin.

        Args:
            name: Name of the skin.
            names: Names of its N cubes.
            poses: Poses of its cubes in the parent frame, in m.
            calibrations: Calibration of each cube.
            elastomer: Elastomer that the skin file states, for the depth of the cubes below the
                surface; None: the cubes have the default depth.
        """
        # A large skin gets fewer points per cube, so that all have about `MAX_SURFACE_POINTS`.
        points_per_side = (MAX_SURFACE_POINTS / len(names)) ** 0.5
        points_per_side = min(max(points_per_side, 2), MAX_POINTS_PER_SIDE)
        self.name, self.names = name, list(names)
        depth = elastomer.depth if elastomer else SURFACE_DEPTH
        self.surface = Surface(poses, depth, int(points_per_side))
        self.field = FieldModel(self.surface, calibrations)
        self.scene = Scene(names, poses, self.surface)


class ViewSettings(NamedTuple):
    """What the user of a page has chosen to see.

    Attributes:
        quantity: The quantity that the colours show.
        fixed_top: Upper end of the colour scale, in SI units; 0: it follows the values.
        cube: Index of the chosen cube.
        parts: Those of `PARTS` (of the 3-D view) that are drawn.
        charts: What the charts show.
        is_paused: Whether the page or the replay is stopped.
        is_recording: Whether a bag is being recorded.
    """

    quantity: Quantity
    fixed_top: float
    cube: int
    parts: set[str]
    charts: tuple[Chart, ...]
    is_paused: bool
    is_recording: bool


def build_update(
    skin: ShownSkin,
    scan: Scan,
    history: History,
    settings: ViewSettings,
    before: Ranges,
) -> tuple[Update, Ranges]:
    """Return everything that a page shows of one scan.

    Args:
        skin: The skin.
        scan: Values of all cubes at the instant that is shown.
        history: Values of all cubes in the last seconds; the newest are those of the scan.
        settings: What the user has chosen.
        before: Upper ends of the automatic ranges in the picture of the scan before, from which
            they fall slowly.

    Returns:
        Name of an object on the page -> its properties; upper ends of the ranges in this picture.
    """
    cube = settings.cube
    colouring = Colouring.from_scan(
        scan,
        skin.surface,
        settings.quantity,
        settings.fixed_top,
        before.colours,
    )
    ranges = before.follow(scan.values, scan.residual, colouring.top)
    update = skin.scene.draw(
        scan,
        colouring,
        settings.parts,
        cube,
        ranges,
    )

    above = None if colouring.above is None else colouring.above[cube]
    # Each text is the content of an HTML element of the same name (page.py).
    texts = {
        "headline": markup.make_headline(scan, settings.is_paused, settings.is_recording),
        "legend": markup.make_legend(settings.quantity, colouring.top, scan.field),
        "meaning": markup.make_explanation(
            skin.scene.bar,
            *skin.scene.find_values_per_bar(ranges),
            scan.field,
        ),
        "numbers": markup.make_numbers_table(scan, cube, above),
        "contact list": markup.make_contacts_table(scan),
        "health": markup.describe_conditions(skin.names, scan),
    }
    update |= {name: {"content": text} for name, text in texts.items()}
    for number, chart in enumerate(settings.charts):
        update[f"chart {number}"] = make_chart_properties(history, chart)
    return update | _list_options(history, scan, settings), ranges


def _list_options(
    history: History,
    scan: Scan,
    settings: ViewSettings,
) -> Update:
    """Return the entries of the drop-down lists: only what can be shown of this skin.

    The standard deviation of the pressure stays in the list of colours while it is chosen, so that
    the colours do not change their meaning when the node that computes it ends.
    """
    observed = history.observed_names
    # Until the first tensors arrive, it is unknown which components the cubes observe.
    if not observed.intersection(COMPONENTS):
        return {}
    quantities = [
        quantity.label
        for name, quantity in QUANTITIES.items()
        if name not in COMPONENTS or name in observed
    ]
    if scan.field.sigma is not None or settings.quantity is DEVIATION:
        quantities.append(DEVIATION.label)
    groups = []
    for group, names in GROUPS.items():
        if observed.intersection(names):
            groups.append(group)
    update: Update = {"colour": {"options": tuple(quantities)}}
    for number in range(len(settings.charts)):
        update[f"chart list {number}"] = {"options": tuple(groups)}
    return update
