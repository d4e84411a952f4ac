"""What the indenters of a load script do to a skin, and the stress it makes at each cube."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ..config.load_script import Action, Indenter, Script, between, read_script
from ..config.package_data import package_data
from ..config.skin import Skin
from ..core.errors import ConfigError
from ..core.scene import CubePoses
from ..core.tensor import rotation_from_rpy
from ..elastic import contact

Array = NDArray[np.float64]
SLOW = 1e-3
"""Speed at which friction has reached 0.7 of its full size, m/s: it turns round smoothly where a
slide does."""
WIDEST = 12
"""Contact's radius over the cubes' depth at most: wider ones take more points than anybody can wait
for."""
_STEPS = np.array([2, 3, 4, 6, 8, 11, 16, 23, 32, 45, 64])
"""Orders of quadrature in use: few different ones, so that cubes are computed together."""


def default_script() -> Script:
    """The script of those who name none: something wanders over the whole skin."""
    return read_script(package_data() / "config" / "load_demo.yaml")


class Press(NamedTuple):
    """What one indenter does at one time, in the skin's parent frame.

    place (3,) m, normal (3,) out of the skin there, force (3,) N on the skin, radius of the contact
    in m.
    """

    shape: str
    place: Array
    normal: Array
    force: Array
    radius: float


class Load:
    """A script on a skin: the same at the same time in every process.

    Each cube sees the half space whose surface lies `script.depth` above it, across its own z axis,
    with the load at the foot of its perpendicular; a cube that is turned away from the load by an
    angle sees the angle's cosine of it, beyond a right angle nothing. A sphere's contact is
    Hertz's: a³ = 3 F R (1 − ν²) / (4 E). The tangential force of a slide is friction × normal force
    along its velocity v, times v / √(v² + SLOW²).

    Source: K. L. Johnson, Contact Mechanics (1985), 4.2 (Hertz), 7.1 (sliding), 8.1 (rolling with
    traction).
    """

    def __init__(self, skin: Skin, script: Script) -> None:
        """ConfigError: a sphere sinks in deeper than Hertz's contact holds, or a disc is too wide
        for its depth."""
        self.script = script
        self.period = script.period or script.end
        self._position = np.array([cube.xyz for cube in skin.cubes])
        self._turn = np.array([rotation_from_rpy(*cube.rpy) for cube in skin.cubes])
        half = np.array([cube.calibration.half_side for cube in skin.cubes])
        low, high = (
            (self._position - half[:, None]).min(axis=0),
            (self._position + half[:, None]).max(axis=0),
        )
        self._centre, self._span = (low + high) / 2, (high - low) / 2
        self.places = CubePoses(self._position, self._turn, half)
        self._pitch = self.places.pitch
        self._paths = {id(a): self._path(a) for i in script.indenters for a in i.actions}
        for indenter in script.indenters:
            most = max(action.force.max() for action in indenter.actions)
            if (radius := self._radius(indenter, most)) > indenter.radius:
                raise ConfigError(
                    f"{indenter.name}: under {most:g} N the contact's radius is {1e3 * radius:.3g} mm, the sphere's "
                    f"only {1e3 * indenter.radius:g} mm; take less force or a larger radius"
                )
            if radius > WIDEST * script.depth:
                raise ConfigError(
                    f"{indenter.name}: the contact's radius is {1e3 * radius:g} mm, the cubes' depth "
                    f"{1e3 * script.depth:g} mm; take several contacts of at most {WIDEST} times the depth"
                )

    def at(self, seconds: float) -> tuple[Array, Array]:
        """Stress (cubes, 6) in Pa and gradient (cubes, 6, 3) in Pa/m, order xx yy zz yz zx xy, in
        the cubes' frames."""
        stress, gradient = np.zeros((len(self._turn), 6)), np.zeros((len(self._turn), 6, 3))
        for press in self.presses(seconds):
            local = np.einsum("nij,ni->nj", self._turn, press.place - self._position)
            away = np.hypot(local[:, 0], local[:, 1])
            facing = np.maximum(self._turn[:, :, 2] @ press.normal, 0.0)
            force = np.einsum("nij,i->nj", self._turn, press.force) * facing[:, None]
            orders = _orders(press.shape, press.radius, self.script.depth, away)
            for order in np.unique(orders[facing > 0]).tolist():
                rows = np.flatnonzero((orders == order) & (facing > 0))
                points, share_of = _points(press.shape, order)
                sources = local[rows, None, :] * (1.0, 1.0, 0.0) + press.radius * points
                below = np.array([[0.0, 0.0, -self.script.depth]])
                found = contact.field(
                    below, sources, force[rows, None, :] * share_of, self.script.poisson
                )
                stress[rows] += found[0][:, 0]
                gradient[rows] += found[1][:, 0]
        return stress, gradient

    def presses(self, seconds: float) -> list[Press]:
        """Of each indenter that touches the skin at this time, what it does."""
        if self.script.period is not None:
            seconds %= self.script.period
        found = []
        for indenter in self.script.indenters:
            for action in indenter.actions:
                if action.start <= seconds < action.end:
                    press = self._press(indenter, action, seconds)
                    found += [press] if press.force.any() else []
        return found

    def total(self, seconds: float) -> tuple[Array, Array, Array]:
        """Sum (3,) of all forces on the skin in N, their centre of pressure (3,) in m and the mean
        normal (3,) there.

        Without load centre and normal are NaN.
        """
        presses = self.presses(seconds)
        weight = np.array([-press.force @ press.normal for press in presses])
        if not presses:
            return np.zeros(3), np.full(3, np.nan), np.full(3, np.nan)
        centre = weight @ np.array([press.place for press in presses]) / weight.sum()
        normal = weight @ np.array([press.normal for press in presses])
        return (
            np.sum([press.force for press in presses], axis=0),
            centre,
            normal / np.linalg.norm(normal),
        )

    def _press(self, indenter: Indenter, action: Action, seconds: float) -> Press:
        when = (seconds - action.start) / (action.end - action.start)
        path = self._paths[id(action)]
        place = path(when) if path else self._place(action.path[0])
        normal = self._normal(place)
        size = float(between(action.force, when))
        if path and action.kind == "slide":
            velocity = path(when, 1) / (action.end - action.start)
            velocity -= normal * (velocity @ normal)
            shear = (
                indenter.friction
                * size
                * velocity
                / math.hypot(float(np.linalg.norm(velocity)), SLOW)
            )
        else:
            steady = len(action.shear) == 1
            shear = (
                action.shear[0] * size / action.force.max()
                if steady
                else between(action.shear, when)
            )
            shear = shear - normal * (shear @ normal)
        return Press(
            indenter.shape, place, normal, shear - size * normal, self._radius(indenter, size)
        )

    def _radius(self, indenter: Indenter, force: float) -> float:
        if indenter.shape == "disc":
            return indenter.radius
        stiffness = self.script.young / (1 - self.script.poisson**2)
        return float(np.cbrt(3 * force * indenter.radius / (4 * stiffness)))

    def _place(self, place: Array) -> Array:
        return self._centre + place * self._span if self.script.relative else place

    def _path(self, action: Action) -> CubicSpline | None:
        """Through all places at equal intervals; at rest at both ends, unless it is closed."""
        if len(action.path) == 1:
            return None
        closed = len(action.path) > 2 and np.array_equal(action.path[0], action.path[-1])
        when = np.linspace(0, 1, len(action.path))
        return CubicSpline(
            when, self._place(action.path), bc_type="periodic" if closed else "clamped"
        )

    def _normal(self, place: Array) -> Array:
        """(3,) out of the skin: the mean of the cubes' z axes, near ones first."""
        square = ((self._position - place) ** 2).sum(axis=1)
        weight = np.exp((square.min() - square) / (2 * self._pitch**2))
        normal = weight @ self._turn[:, :, 2]
        length = np.linalg.norm(normal)
        return normal / length if length > 0 else self._turn[np.argmin(square), :, 2]


def _orders(shape: str, radius: float, depth: float, away: Array) -> NDArray[np.int64]:
    """Order of quadrature for each cube, `away` m from the contact's axis: few points for those who
    see it from afar.

    Stress and gradient are within 1e-3 of their greatest value; what point forces make is in
    balance in any case.
    """
    near = radius / np.hypot(depth, np.maximum(away - radius, 0.0))
    wanted = 5 * near + 1 if shape == "sphere" else 3.3 * near + 0.5
    return np.where(near < 0.15, 1, _STEPS[np.searchsorted(_STEPS, wanted)])


@lru_cache(maxsize=64)
def _points(shape: str, order: int) -> tuple[Array, Array]:
    """Points (L, 3) of a contact of radius 1 and each one's share (L, 1) of the force."""
    if shape == "sphere" and order > 1:
        points, share_of = contact.hertz(1.0, (0.0, 0.0, 1.0), order=order)
    else:
        # Seen from afar a sphere's contact is a disc with the same second moment: 2/5 a² against
        # 1/2 a².
        points, share_of = contact.disc(
            math.sqrt(0.8) if shape == "sphere" else 1.0, (0.0, 0.0, 1.0), order=order
        )
    return points, share_of[:, 2:]
