# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Loads on a simulated skin: the contacts of a load script and the stress at each cube."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from ..config.load_script import Action, Indenter, Script, interpolate_knots, read_script
from ..config.package_data import find_package_data
from ..config.skin import Skin
from ..core.arrays import Array, Index
from ..core.errors import ConfigError
from ..core.poses import CubePoses
from ..mechanics import contact
from .spline import CubicSpline

if TYPE_CHECKING:
    from ..touch.surface import Contact

FRICTION_SPEED = 1e-3
"""Speed, in m/s, at which the friction force of a slide has 0.7 of its full size. It lets the force
change smoothly where a slide reverses its direction."""

MAX_RADIUS_DEPTHS = 12
"""Largest allowed radius of a contact, divided by the depth of the cubes' centres. Larger contacts
need more point forces, and computing their stress would take minutes."""

MAX_CACHED_BYTES = 64 << 20
"""Maximum memory, in bytes, of the stress fields that `remember` keeps for a repeated load."""

_ORDERS = np.array([2, 3, 4, 6, 8, 11, 16, 23, 32, 45, 64])
"""Numbers of concentric rings of point forces by which a contact can be represented (quadrature
orders). There are only a few, so that many cubes have the same order and are computed together."""

_FAR_RATIO = 0.15
"""Ratio of the radius of a contact to the distance between a cube and the rim of the contact. Below
this ratio, one ring of point forces represents the contact accurately enough for this cube."""


def read_default_script() -> Script:
    """Read the load script in the package, in which an indenter moves over a skin of any size."""
    return read_script(find_package_data() / "config" / "load_demo.yaml")


StressField = tuple[Array, Array]
"""Stress (cubes, 6) in Pa and its gradient (cubes, 6, 3) in Pa/m at the cubes of a skin, in the
frames of the cubes. The components are in the order xx yy zz yz zx xy."""

Resultant = tuple[Array, Array, Array]
"""Force (3,) on the skin in N, centre of pressure (3,) in m and mean normal (3,) out of the skin of
some contacts together, in the skin's parent frame. Without a contact, centre and normal are NaN."""


class ContactLoad(NamedTuple):
    """One contact at one time, in the skin's parent frame.

    Attributes:
        shape: `disc` for uniform traction, `sphere` for the traction of a Hertz contact.
        position: Centre (3,) of the contact in m.
        normal: Unit normal (3,) out of the skin.
        force: Force (3,) in N on the skin.
        radius: Radius of the contact in m.
    """

    shape: str
    position: Array
    normal: Array
    force: Array
    radius: float


class Fields(Protocol):
    """Stress and gradient at the cubes of a skin over time."""

    @property
    def repeats(self) -> float | None:
        """Time in s after which the load repeats; None: it never repeats."""

    @property
    def period(self) -> float:
        """Time in s after which the load repeats; if it never does, a typical duration instead."""

    def compute_stress_field(self, seconds: float) -> StressField:
        """Compute stress and gradient at the cubes at a simulated time in s.

        Returns:
            Stress (cubes, 6) in Pa and gradient (cubes, 6, 3) in Pa/m, order xx yy zz yz zx xy, in
            the frames of the cubes.
        """


class AnyLoad(Fields, Protocol):
    """Load on the cubes of a skin: a script, or a robot in simulation."""

    @property
    def poses(self) -> CubePoses:
        """Poses of the cubes."""

    @property
    def depth(self) -> float:
        """Distance from the centres of the cubes to the surface, in m."""

    def compute_resultant(self, seconds: float) -> Resultant:
        """Return the resultant of all contacts at a time, in the skin's parent frame.

        It consists of the total force (3,) in N, the centre of pressure (3,) in m, and the mean
        normal (3,) out of the skin.

        Args:
            seconds: Simulated time in s.
        """


def read_load(
    skin: Skin,
    script: Path | None,
    scene: Path | None = None,
) -> AnyLoad:
    """Read the load on a skin.

    Args:
        skin: The skin.
        script: Load script; None: the one in the package.
        scene: MuJoCo scene whose bodies touch the skin, instead of a script.

    Raises:
        ConfigError: The script or the scene cannot be used with this skin.
    """
    if scene is not None:
        # MuJoCo is optional, and importing it takes long.
        from .mujoco.scene import MujocoLoad

        return MujocoLoad(scene, skin)
    return Load(skin, read_default_script() if script is None else read_script(script))


class Load:
    """The load of a script on a skin. It depends on the time only, and so is reproducible.

    The stress at each cube is that in a half space whose surface lies `depth` above the cube,
    perpendicular to its z axis. The position of a contact is projected onto this surface. If the
    cube is tilted by an angle against the normal of the contact, the force is multiplied by the
    cosine of the angle; beyond a right angle, it is 0. A sphere of radius R under the normal force
    F has a Hertz contact of the radius a, a³ = 3 F R (1 − ν²) / (4 E), with Young's modulus E and
    Poisson's ratio ν of the elastomer. The tangential force of a slide acts along its velocity. It
    is the coefficient of friction times the normal force, multiplied by v / √(v² +
    FRICTION_SPEED²) with the speed v.

    Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz), 7.1 (sliding), 8.1 (rolling with
    traction).

    Attributes:
        script: Script with the actions of all indenters.
        poses: Poses of the cubes.
        depth: Distance from the centres of the cubes to the surface, in m.
        repeats: Time in s after which the script repeats; None: it plays once.
        period: Time in s after which the script repeats, or the length of a script that plays once.
    """

    def __init__(self, skin: Skin, script: Script) -> None:
        """Prepare the paths of all indenters.

        Raises:
            ConfigError: The contact of a sphere is wider than the sphere, or a contact is wider
                than `MAX_RADIUS_DEPTHS` allows.
        """
        self.script = script
        self.depth = script.depth
        self.repeats = script.period
        self.period = script.period or script.end
        self.poses = skin.poses
        self._pitch = self.poses.pitch

        # A script may contain relative positions, from -1 to 1 along each side of the box around
        # all cubes.
        half = self.poses.half_side[:, None]
        low = (self.poses.position - half).min(axis=0)
        high = (self.poses.position + half).max(axis=0)
        self._centre = (low + high) / 2
        self._half_extent = (high - low) / 2
        self._paths = {
            id(action): self._plan_path(action)
            for indenter in script.indenters
            for action in indenter.actions
        }
        for indenter in script.indenters:
            self._check(indenter)

    def compute_stress_field(self, seconds: float) -> StressField:
        """Compute stress (cubes, 6) in Pa and gradient (cubes, 6, 3) in Pa/m at a time in s."""
        # For each cube, the surface is the plane z = 0, and the cube is at z = -depth.
        position, rotation, _ = self.poses
        n = len(position)
        stress = np.zeros((n, 6))
        gradient = np.zeros((n, 6, 3))
        below = np.array([[0.0, 0.0, -self.depth]])
        outward = rotation[:, :, 2]
        for load in self.find_contact_loads(seconds):
            # Position of the contact and force, in the frame of each cube.
            offset = load.position - position
            local = np.einsum("nij,ni->nj", rotation, offset)
            facing = np.maximum(outward @ load.normal, 0.0)
            force = np.einsum("nij,i->nj", rotation, load.force)
            force *= facing[:, None]
            distance = np.hypot(local[:, 0], local[:, 1])
            orders = _choose_orders(
                load.shape,
                load.radius,
                self.depth,
                distance,
            )

            # Cubes with the same quadrature order are computed together.
            is_facing = facing > 0
            for order in np.unique(orders[is_facing]).tolist():
                rows = np.flatnonzero((orders == order) & is_facing)
                points, weights = _make_unit_points(load.shape, order)
                in_plane = local[rows, None, :] * (1.0, 1.0, 0.0)
                sources = in_plane + load.radius * points
                forces = force[rows, None, :] * weights
                part, slope = contact.field(
                    below,
                    sources,
                    forces,
                    self.script.poisson,
                )
                stress[rows] += part[:, 0]
                gradient[rows] += slope[:, 0]
        return stress, gradient

    def find_contact_loads(self, seconds: float) -> list[ContactLoad]:
        """Return the contacts of all indenters that touch the skin at a time in s."""
        if self.script.period is not None:
            seconds %= self.script.period
        loads = [
            self._make_contact_load(indenter, action, seconds)
            for indenter in self.script.indenters
            for action in indenter.actions
            if action.start <= seconds < action.end
        ]
        # The force is 0 at the start and at the end of an action, where the indenter does not
        # touch the skin.
        return [load for load in loads if load.force.any()]

    def compute_resultant(self, seconds: float) -> Resultant:
        """Return total force, centre of pressure and mean normal of all contacts at a time in s."""
        return compute_resultant(self.find_contact_loads(seconds))

    def _check(self, indenter: Indenter) -> None:
        """Raise ConfigError if an indenter's contact under its largest force is too wide.

        A sphere's contact must not be wider than the sphere, and no contact wider than
        `MAX_RADIUS_DEPTHS` allows.
        """
        force = max(action.force.max() for action in indenter.actions)
        radius = self._compute_contact_radius(indenter, force)
        if radius > indenter.radius:
            raise ConfigError(
                f"{indenter.name}: under {force:g} N the contact's radius is "
                f"{1e3 * radius:.3g} mm, the sphere's only {1e3 * indenter.radius:g} mm; "
                "take less force or a larger radius"
            )
        if radius > MAX_RADIUS_DEPTHS * self.depth:
            raise ConfigError(
                f"{indenter.name}: the contact's radius is {1e3 * radius:g} mm, the cubes' depth "
                f"{1e3 * self.depth:g} mm; take several contacts of at most {MAX_RADIUS_DEPTHS} "
                "times the depth"
            )

    def _make_contact_load(
        self,
        indenter: Indenter,
        action: Action,
        seconds: float,
    ) -> ContactLoad:
        """Return the contact of an indenter at a time during one of its actions.

        Args:
            indenter: The indenter.
            action: Action of the indenter during which the time lies.
            seconds: Time in s since the start of the script.
        """
        duration = action.end - action.start
        progress = (seconds - action.start) / duration  # 0 to 1
        path = self._paths[id(action)]
        position, velocity = self._to_metres(action.path[0]), np.zeros(3)
        if path:
            position, velocity = path.interpolate(progress)
        normal = compute_surface_normal(self.poses, self._pitch, position)
        size = float(interpolate_knots(action.force, progress))
        if path and action.kind == "slide":
            # Friction acts along the part of the velocity that is tangential to the skin.
            velocity = velocity / duration
            velocity -= normal * (velocity @ normal)
            speed = float(np.linalg.norm(velocity))
            shear = indenter.friction * size * velocity
            shear /= math.hypot(speed, FRICTION_SPEED)
        else:
            if len(action.shear) == 1:
                # A single value of the shear force applies at the largest normal force; at other
                # times the shear force is proportional to the normal force.
                shear = action.shear[0] * size / action.force.max()
            else:
                shear = interpolate_knots(action.shear, progress)
            shear = shear - normal * (shear @ normal)
        radius = self._compute_contact_radius(indenter, size)
        return ContactLoad(
            indenter.shape,
            position,
            normal,
            force=shear - size * normal,
            radius=radius,
        )

    def _compute_contact_radius(self, indenter: Indenter, force: float) -> float:
        """Return the radius of a contact, in m.

        Args:
            indenter: Indenter, whose shape and size determine the radius.
            force: Normal force in N.
        """
        if indenter.shape == "disc":
            return indenter.radius
        # Hertz: a³ = 3 F R / (4 E*) for the contact radius a, with E* = E / (1 − ν²); Johnson 4.2
        stiffness = self.script.young / (1 - self.script.poisson**2)
        cube_of_radius = 3 * force * indenter.radius / (4 * stiffness)
        return float(np.cbrt(cube_of_radius))

    def _to_metres(self, position: Array) -> Array:
        """Convert positions of the script to metres in the skin's parent frame.

        Args:
            position: Positions (..., 3), in m or, in a script with relative positions, from -1 to 1
                along each side of the box around all cubes.
        """
        if not self.script.relative:
            return position
        return np.asarray(self._centre + position * self._half_extent)

    def _plan_path(self, action: Action) -> CubicSpline | None:
        """Return the path of an indenter through all positions of an action, at equal intervals.

        The indenter starts and ends at rest. Only if the path has at least three positions and the
        last one equals the first one, the indenter passes this position with the same velocity at
        both times. The result is None for an action with a single position.
        """
        if len(action.path) == 1:
            return None
        first, last = action.path[0], action.path[-1]
        closed = len(action.path) > 2 and np.array_equal(first, last)
        return CubicSpline(self._to_metres(action.path), closed=closed)


def compute_surface_normal(
    poses: CubePoses,
    pitch: float,
    position: Array,
) -> Array:
    """Return the unit normal (3,) out of the skin at a position, in the skin's parent frame.

    It is the mean of the cubes' z axes, weighted with a Gaussian of the distance.

    Args:
        poses: Poses of the cubes.
        pitch: Typical distance of neighbouring cubes in m (`poses.pitch`, whose computation takes
            long).
        position: Position (3,) in m.
    """
    offset = poses.position - position
    square = (offset**2).sum(axis=1)
    nearest = np.argmin(square)
    excess = square - square[nearest]
    weight = np.exp(-excess / (2 * pitch**2))
    normal = weight @ poses.rotation[:, :, 2]
    length = np.linalg.norm(normal)
    # Opposite z axes may add up to 0; then the axis of the nearest cube is the normal.
    if length > 0:
        return np.asarray(normal / length)
    return np.asarray(poses.rotation[nearest, :, 2])


def compute_resultant(loads: Sequence[ContactLoad | Contact]) -> Resultant:
    """Return the total force of some contacts, their centre of pressure and mean normal.

    Returns:
        Force (3,) on the skin in N, centre of pressure (3,) in m and mean normal (3,), which points
        out of the skin; all in the skin's parent frame. Without a load, centre and normal are NaN.
    """
    if not loads:
        unknown = np.full(3, np.nan)
        return np.zeros(3), unknown, unknown
    # The weight of a contact is its force along the normal into the skin.
    positions = np.array([load.position for load in loads])
    normals = np.array([load.normal for load in loads])
    forces = np.array([load.force for load in loads])
    weight = -(forces * normals).sum(axis=1)
    centre = weight @ positions / weight.sum()
    normal = weight @ normals
    normal /= np.linalg.norm(normal)
    return forces.sum(axis=0), centre, normal


def remember(load: Fields) -> Callable[[int], StressField]:
    """Return a function of a time in whole µs that gives the stress fields of a load.

    If the load repeats, the function keeps the fields for the next period, because computing them
    takes long.
    """
    period_us = math.inf if load.repeats is None else round(1e6 * load.repeats)
    field_bytes = sum(part.nbytes for part in load.compute_stress_field(0.0))

    @lru_cache(MAX_CACHED_BYTES // field_bytes)
    def compute_at(time_us: float) -> StressField:
        return load.compute_stress_field(time_us * 1e-6)

    return lambda time_us: compute_at(time_us % period_us)


def _choose_orders(
    shape: str,
    radius: float,
    depth: float,
    distance: Array,
) -> Index:
    """Return the number of rings of point forces (cubes,) that represent a contact for each cube.

    Cubes far from the contact need fewer rings. The errors of stress and gradient are at most 1e-3
    of their largest values. With any number of rings, the stress is in equilibrium with the force.

    Args:
        shape: Shape of the contact, `disc` or `sphere`.
        radius: Radius of the contact in m.
        depth: Distance from the centres of the cubes to the surface, in m.
        distance: Distance (cubes,) of the cubes from the axis of the contact, in m.
    """
    to_rim = np.maximum(distance - radius, 0.0)
    ratio = radius / np.hypot(depth, to_rim)
    # With these factors, the errors are at most 1e-3 of the largest stress and gradient, as
    # numerical tests have shown.
    wanted = 3.3 * ratio + 0.5
    if shape == "sphere":
        wanted = 5 * ratio + 1
    orders = _ORDERS[np.searchsorted(_ORDERS, wanted)]
    return np.where(ratio < _FAR_RATIO, 1, orders)


@lru_cache(maxsize=64)
def _make_unit_points(shape: str, order: int) -> tuple[Array, Array]:
    """Return the point forces that represent a contact of radius 1.

    Args:
        shape: Shape of the contact, `disc` or `sphere`.
        order: Quadrature order (number of rings of point forces).

    Returns:
        Positions (L, 3) of the forces, and the fraction (L, 1) of the total force on each.
    """
    unit_force = (0.0, 0.0, 1.0)
    if shape == "sphere" and order > 1:
        points, forces = contact.hertz(1.0, unit_force, order=order)
    else:
        # Far away, the stress under a sphere is that under a disc with the same second moment of
        # the pressure: 2/5 a² for a Hertz contact of radius a, 1/2 a² for a disc.
        radius = math.sqrt(0.8) if shape == "sphere" else 1.0
        points, forces = contact.disc(radius, unit_force, order=order)
    return points, forces[:, 2:]
