"""What the indenters of a load script do to a skin, and the stress it makes at each cube."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..config.load_script import Action, Indenter, Script, interpolate_knots, read_script
from ..config.package_data import package_data
from ..config.skin import Skin
from ..core.arrays import Array
from ..core.errors import ConfigError
from ..core.poses import CubePoses
from ..core.tensor import rotation_from_rpy
from ..mechanics import contact
from .spline import CubicSpline

SLOW = 1e-3
"""Speed at which friction has reached 0.7 of its full size, m/s: so it changes direction smoothly
where a slide does."""
WIDEST = 12
"""Radius of a contact over the depth of the cubes, at most: wider ones need so many points that
nobody can wait for them."""
KEPT_BYTES = 64 << 20
"""What the fields that are kept may take."""
_ORDERS = np.array([2, 3, 4, 6, 8, 11, 16, 23, 32, 45, 64])
"""Orders of quadrature in use: few, so that many cubes are computed together."""


def default_script() -> Script:
    """The shipped script, for any skin: an indenter wanders over all of it."""
    return read_script(package_data() / "config" / "load_demo.yaml")


class Press(NamedTuple):
    """What one indenter does at one time, in the skin's parent frame.

    shape: disc or sphere
    position: (3,) m, centre of the contact
    normal: (3,) out of the skin there
    force: (3,) N on the skin
    radius: of the contact, m
    """

    shape: str
    position: Array
    normal: Array
    force: Array
    radius: float


class Fields(Protocol):
    """Stress and gradient at the cubes of a skin as time goes on.

    repeats: time after which all comes again, s; None: never
    period: the same, or the time that counts as the whole of it, s
    """

    @property
    def repeats(self) -> float | None: ...

    @property
    def period(self) -> float: ...

    def at(self, seconds: float) -> tuple[Array, Array]:
        """Stress (cubes, 6) in Pa and gradient (cubes, 6, 3) in Pa/m, order xx yy zz yz zx xy, in
        the cubes' frames."""


class AnyLoad(Fields, Protocol):
    """What acts on the cubes of a skin: a script, or a robot in simulation.

    poses: of the cubes; depth: from their centres to the surface, m
    """

    @property
    def poses(self) -> CubePoses: ...

    @property
    def depth(self) -> float: ...

    def total(self, seconds: float) -> tuple[Array, Array, Array]:
        """As the function `total`, of what touches the skin at this time."""


class Load:
    """A script on a skin: the same at the same time in every process.

    Each cube sees a half space whose surface lies `script.depth` above it, across its own z axis,
    with the load at the foot of its perpendicular. A cube that is tilted away from the load by an
    angle sees the load times the angle's cosine, and nothing beyond a right angle. A sphere's
    contact is Hertz's: a³ = 3 F R (1 − ν²) / (4 E). The tangential force of a slide is friction ×
    normal force along its velocity v, times v / √(v² + SLOW²).

    Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz), 7.1 (sliding), 8.1 (rolling with
    traction).

    poses, depth, repeats, period: as in `AnyLoad`; period: the script's length if it plays once
    """

    def __init__(self, skin: Skin, script: Script) -> None:
        """ConfigError: a sphere sinks in deeper than Hertz's contact holds, or a disc is too wide
        for its depth."""
        self.script = script
        self.depth, self.repeats = script.depth, script.period
        self.period = script.period or script.end
        self._position = np.array([cube.xyz for cube in skin.cubes])
        self._rotation = np.array([rotation_from_rpy(*cube.rpy) for cube in skin.cubes])
        half = np.array([cube.calibration.half_side for cube in skin.cubes])
        low = (self._position - half[:, None]).min(axis=0)
        high = (self._position + half[:, None]).max(axis=0)
        self._centre, self._half_extent = (low + high) / 2, (high - low) / 2
        self.poses = CubePoses(self._position, self._rotation, half)
        self._pitch = self.poses.pitch
        self._paths = {
            id(action): self._path(action)
            for indenter in script.indenters
            for action in indenter.actions
        }
        for indenter in script.indenters:
            self._check(indenter)

    def at(self, seconds: float) -> tuple[Array, Array]:
        """Stress (cubes, 6) in Pa and gradient (cubes, 6, 3) in Pa/m, order xx yy zz yz zx xy, in
        the cubes' frames."""
        n = len(self._position)
        stress, gradient = np.zeros((n, 6)), np.zeros((n, 6, 3))
        below = np.array([[0.0, 0.0, -self.script.depth]])
        for press in self.presses(seconds):
            local = np.einsum("nij,ni->nj", self._rotation, press.position - self._position)
            distance = np.hypot(local[:, 0], local[:, 1])
            facing = np.maximum(self._rotation[:, :, 2] @ press.normal, 0.0)
            force = np.einsum("nij,i->nj", self._rotation, press.force) * facing[:, None]
            orders = _orders(press.shape, press.radius, self.script.depth, distance)
            # Cubes with the same order of quadrature are computed together.
            for order in np.unique(orders[facing > 0]).tolist():
                rows = np.flatnonzero((orders == order) & (facing > 0))
                points, weights = _points(press.shape, order)
                sources = local[rows, None, :] * (1.0, 1.0, 0.0) + press.radius * points
                forces = force[rows, None, :] * weights
                field = contact.field(below, sources, forces, self.script.poisson)
                stress[rows] += field[0][:, 0]
                gradient[rows] += field[1][:, 0]
        return stress, gradient

    def presses(self, seconds: float) -> list[Press]:
        """What each indenter does that touches the skin at this time."""
        if self.script.period is not None:
            seconds %= self.script.period
        presses = [
            self._press(indenter, action, seconds)
            for indenter in self.script.indenters
            for action in indenter.actions
            if action.start <= seconds < action.end
        ]
        return [press for press in presses if press.force.any()]

    def total(self, seconds: float) -> tuple[Array, Array, Array]:
        """As `total`, of what presses at this time."""
        return total(self.presses(seconds))

    def _check(self, indenter: Indenter) -> None:
        """ConfigError: the contact is too wide for what is computed."""
        force = max(action.force.max() for action in indenter.actions)
        radius = self._radius(indenter, force)
        if radius > indenter.radius:
            raise ConfigError(
                f"{indenter.name}: under {force:g} N the contact's radius is "
                f"{1e3 * radius:.3g} mm, the sphere's only {1e3 * indenter.radius:g} mm; "
                "take less force or a larger radius"
            )
        if radius > WIDEST * self.script.depth:
            raise ConfigError(
                f"{indenter.name}: the contact's radius is {1e3 * radius:g} mm, the cubes' depth "
                f"{1e3 * self.script.depth:g} mm; take several contacts of at most {WIDEST} times "
                "the depth"
            )

    def _press(self, indenter: Indenter, action: Action, seconds: float) -> Press:
        """when: from 0 at the action's start to 1 at its end."""
        when = (seconds - action.start) / (action.end - action.start)
        path = self._paths[id(action)]
        position = path.position(when) if path else self._in_metres(action.path[0])
        normal = surface_normal(self.poses, self._pitch, position)
        size = float(interpolate_knots(action.force, when))
        if path and action.kind == "slide":
            velocity = path.velocity(when) / (action.end - action.start)
            velocity -= normal * (velocity @ normal)
            speed = float(np.linalg.norm(velocity))
            shear = indenter.friction * size * velocity / math.hypot(speed, SLOW)
        else:
            if len(action.shear) == 1:
                shear = action.shear[0] * size / action.force.max()
            else:
                shear = interpolate_knots(action.shear, when)
            shear = shear - normal * (shear @ normal)
        force = shear - size * normal
        return Press(indenter.shape, position, normal, force, self._radius(indenter, size))

    def _radius(self, indenter: Indenter, force: float) -> float:
        if indenter.shape == "disc":
            return indenter.radius
        stiffness = self.script.young / (1 - self.script.poisson**2)
        return float(np.cbrt(3 * force * indenter.radius / (4 * stiffness)))

    def _in_metres(self, position: Array) -> Array:
        """A position of the script in m in the skin's parent frame."""
        if not self.script.relative:
            return position
        return self._centre + position * self._half_extent

    def _path(self, action: Action) -> CubicSpline | None:
        """Through all positions at equal intervals; at rest at both ends, unless it is closed."""
        if len(action.path) == 1:
            return None
        closed = len(action.path) > 2 and np.array_equal(action.path[0], action.path[-1])
        return CubicSpline(self._in_metres(action.path), closed=closed)


def surface_normal(poses: CubePoses, pitch: float, position: Array) -> Array:
    """(3,) out of the skin: the mean of the cubes' z axes, weighted by how near they are.

    pitch: that of the poses, m, which takes long to find
    """
    square = ((poses.position - position) ** 2).sum(axis=1)
    weight = np.exp((square.min() - square) / (2 * pitch**2))
    normal = weight @ poses.rotation[:, :, 2]
    length = np.linalg.norm(normal)
    return normal / length if length > 0 else poses.rotation[np.argmin(square), :, 2]


def total(presses: Sequence[Press]) -> tuple[Array, Array, Array]:
    """Sum (3,) of all forces on the skin in N, their centre of pressure (3,) in m and the mean
    normal (3,) there.

    Without load centre and normal are NaN.
    """
    if not presses:
        return np.zeros(3), np.full(3, np.nan), np.full(3, np.nan)
    weight = np.array([-press.force @ press.normal for press in presses])
    force = np.sum([press.force for press in presses], axis=0)
    centre = weight @ np.array([press.position for press in presses]) / weight.sum()
    normal = weight @ np.array([press.normal for press in presses])
    return force, centre, normal / np.linalg.norm(normal)


class LoadMemory:
    """The fields of a load at whole microseconds. Those of a periodic script are kept for the next
    time that it comes by there: each costs a contact problem for every cube."""

    def __init__(self, load: Fields) -> None:
        self._load = load
        period = load.repeats
        self._period_us = None if period is None else round(1e6 * period)
        self._fields: dict[int, tuple[Array, Array]] = {}

    def at(self, time_us: int) -> tuple[Array, Array]:
        """As `Load.at`."""
        if self._period_us is not None:
            time_us %= self._period_us
        field = self._fields.get(time_us)
        if field is None:
            field = self._load.at(time_us * 1e-6)
            if (len(self._fields) + 1) * sum(part.nbytes for part in field) > KEPT_BYTES:
                self._fields.clear()
            self._fields[time_us] = field
        return field


def _orders(shape: str, radius: float, depth: float, distance: Array) -> NDArray[np.int64]:
    """Order of quadrature for each cube, `distance` m from the contact's axis: few points for cubes
    that see the contact from afar.

    Stress and gradient are within 1e-3 of their greatest value; any sum of point forces satisfies
    equilibrium.
    """
    near = radius / np.hypot(depth, np.maximum(distance - radius, 0.0))
    wanted = 5 * near + 1 if shape == "sphere" else 3.3 * near + 0.5
    return np.where(near < 0.15, 1, _ORDERS[np.searchsorted(_ORDERS, wanted)])


@lru_cache(maxsize=64)
def _points(shape: str, order: int) -> tuple[Array, Array]:
    """Points (L, 3) of a contact of radius 1 and the part (L, 1) of the force on each of them."""
    if shape == "sphere" and order > 1:
        points, forces = contact.hertz(1.0, (0.0, 0.0, 1.0), order=order)
    else:
        # Seen from afar a sphere's contact is a disc with the same second moment: 2/5 a² against
        # 1/2 a².
        radius = math.sqrt(0.8) if shape == "sphere" else 1.0
        points, forces = contact.disc(radius, (0.0, 0.0, 1.0), order=order)
    return points, forces[:, 2:]
