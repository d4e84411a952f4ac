"""A skin on the bodies of a MuJoCo model: contact forces become tractions, and stress at the cubes.

    import mujoco
    from cube_tensor_driver.simulation.mujoco.source import MujocoSkin

    model = mujoco.MjModel.from_xml_path("robot.xml")
    data = mujoco.MjData(model)
    touch = MujocoSkin(model, data, ctd.read_skin("skin.yaml"))
    while True:
        mujoco.mj_step(model, data)
        rows = touch.read()

The skin sits on the body that has the name of its parent frame. Cubes whose link has the name of
another body sit on that one: so the two fingers of a hand can be one skin. Poses of the skin file
hold in the model's reference configuration (qpos0). The surface is that of the bodies' geoms above
the cubes.

Each cube sees a layer whose surface lies `depth` above it, across its own z axis, as in `load.py`;
patches.py says how contact points become tractions, mechanics/contact_tables.py
what these do to a cube.
Contacts with the back of a body, where no cube looks, are not felt. The contact's own damping is
MuJoCo's.

MuJoCo is the extra `mujoco` of this package; it is loaded when a skin is made.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...config.skin import Skin, SkinCube
from ...core.arrays import Array
from ...core.defaults import POISSONS_RATIO, YOUNGS_MODULUS
from ...core.errors import ConfigError
from ...core.poses import CubePoses
from ...core.reconstructor import Reconstructor
from ...core.rows import FrequencyRows, StressRows
from ...core.tensor import rotation_from_rpy
from ...mechanics.contact_tables import DiscTables, PolygonTables
from ...mechanics.layer import Layer
from ..imperfections import Imperfections
from ..load import Press, surface_normal
from ..source import SkinPads
from .patches import Polygon, flat_contact, hertz_radius

if TYPE_CHECKING:
    from mujoco import MjData, MjModel


SAME_DEPTH = 0.1
"""How far a cube's depth may be from the others', over the depth: there is one table for all."""
LEAST = 0.3
"""Width over the depth of what is flat and touches along a line."""


def load_mujoco() -> Any:
    """The module mujoco. ConfigError: it is not installed."""
    try:
        import mujoco
    except ModuleNotFoundError:
        raise ConfigError(
            "MuJoCo is not installed: pip install 'cube-tensor-driver[mujoco]', or pip install "
            "mujoco in the environment of this program"
        ) from None
    return mujoco


class _Part(NamedTuple):
    """The cubes on one body.

    body: its number; cubes: their numbers in the skin; poses: of the cubes in the parent frame;
    pitch: theirs, m; rotation, position: from the body's frame to the parent frame
    """

    body: int
    cubes: NDArray[np.intp]
    poses: CubePoses
    pitch: float
    rotation: Array
    position: Array


class Touch(NamedTuple):
    """What touches a skin, in the skin's parent frame.

    body: that is touched, its number; press: all of it as one round contact, of the same area;
    polygon: what it is where it is flat, None where it is round
    """

    body: int
    press: Press
    polygon: Polygon | None = None


class MujocoSkin:
    """The cubes of a skin as a sensor of a MuJoCo model.

    depth: from the cubes' centres to the surface, m, as it is in the model
    poses: of the cubes in the skin's parent frame

    Parameters: model, data: of MuJoCo; data is read after each step. thickness: of the elastomer
    over rigid ground, m; inf: a half space. young: Pa, sets how wide round contacts are; poisson.
    noise, drift, imperfections: as in `simulate`. Setting up takes seconds the first time.

    ConfigError: MuJoCo is not installed, the model has no body of that name, or a cube does not
    lie below the surface of its body. ElasticError: thickness, poisson and depth make no layer.
    """

    def __init__(
        self,
        model: MjModel,
        data: MjData,
        skin: Skin,
        *,
        thickness: float = np.inf,
        young: float = YOUNGS_MODULUS,
        poisson: float = POISSONS_RATIO,
        noise: float | None = 0.0,
        drift: float = 0.0,
        imperfections: Imperfections | None = None,
    ) -> None:
        self._mujoco = load_mujoco()
        self.model, self.data, self.skin = model, data, skin
        self.poses = CubePoses(
            position=np.array([cube.xyz for cube in skin.cubes]),
            rotation=np.array([rotation_from_rpy(*cube.rpy) for cube in skin.cubes]),
            half_side=np.array([cube.calibration.half_side for cube in skin.cubes]),
        )
        self._parts, self.depth = self._attach()
        self._discs, self._polygons = _tables(Layer(thickness, poisson), round(self.depth, 6))
        self._stiffness = young / (1 - poisson**2)
        self._curvature = _curvatures(model, self._mujoco)
        self._pads = SkinPads(skin, noise, drift, imperfections)
        self._reconstructor = Reconstructor(skin)
        self._scans = 0

    def read(self) -> StressRows:
        """What the cubes report of the state of `data`: call it after mj_step."""
        return self._reconstructor.process(self.frequencies())

    def frequencies(self) -> FrequencyRows:
        """What the pads measure in the state of `data`; stamps are its time."""
        stress, gradient = self.field(self.touches())
        self._scans += 1
        return self._pads.rows(stress, gradient, self._scans - 1, round(1e6 * self.data.time))

    def touches(self) -> list[Touch]:
        """What touches the skin in the state of `data`."""
        data, found = self.data, []
        geoms = data.contact.geom[: data.ncon]
        # A flexible body has no geom: its number is negative.
        bodies = np.where(geoms >= 0, self.model.geom_bodyid[geoms], -1)
        for part in self._parts:
            for side in (0, 1):
                rows = np.flatnonzero(bodies[:, side] == part.body)
                for other in np.unique(geoms[rows, 1 - side]):
                    same = rows[geoms[rows, 1 - side] == other]
                    found += self._touch(part, same, side)
        return found

    def field(self, touches: list[Touch]) -> tuple[Array, Array]:
        """Stress (cubes, 6) in Pa and gradient (cubes, 6, 3) in Pa/m at the cubes, in their frames,
        order xx yy zz yz zx xy."""
        n = len(self.poses.position)
        stress, gradient = np.zeros((n, 6)), np.zeros((n, 6, 3))
        for part in self._parts:
            mine = [touch for touch in touches if touch.body == part.body]
            presses = [touch.press for touch in mine if touch.polygon is None]
            flat = [(t.polygon, t.press.normal) for t in mine if t.polygon is not None]
            found = []
            if presses:
                found.append(_under_discs(part, presses, self._discs))
            if flat:
                found.append(_under_polygons(part, flat, self._polygons))
            for one, its_gradient in found:
                stress[part.cubes] += one
                gradient[part.cubes] += its_gradient
        return stress, gradient

    def _touch(self, part: _Part, rows: NDArray[np.intp], side: int) -> list[Touch]:
        """The contacts `rows` of one pair of bodies; none where they do not press on the front.

        side: 1 where the skin is the second of the two, on which MuJoCo's forces act.
        """
        data, contact, sign = self.data, self.data.contact, 2 * side - 1
        frames, places = contact.frame[rows].reshape(-1, 3, 3), contact.pos[rows]
        back = data.xmat[part.body].reshape(3, 3)
        turn = part.rotation @ back.T
        inside, six = np.empty((len(rows), 3)), np.empty(6)
        for number, row in enumerate(rows.tolist()):
            self._mujoco.mj_contactForce(self.model, data, row, six)
            inside[number] = six[:3]
        place = (places - data.xpos[part.body]) @ turn.T + part.position
        force = sign * np.einsum("nj,njk->nk", inside, frames) @ turn.T
        outward = -sign * frames[:, 0] @ turn.T
        normal = surface_normal(part.poses, part.pitch, place.mean(axis=0))
        felt = (outward @ normal > 0) & (force @ normal < 0)
        if not felt.any():
            return []
        place, force = place[felt], force[felt]
        total = force.sum(axis=0)
        if len(place) > 1:
            polygon = flat_contact(place, force, normal, LEAST * self.depth)
            radius = np.sqrt(total @ normal / (polygon.traction @ normal) / np.pi)
            press = Press("disc", polygon.centre, normal, total, float(radius))
            return [Touch(part.body, press, polygon)]
        curvature = self._curvature[contact.geom[rows[0]]].sum()
        radius = hertz_radius(-float(total @ normal), curvature, self._stiffness)
        return [Touch(part.body, Press("sphere", place[0], normal, total, radius))]

    def _attach(self) -> tuple[list[_Part], float]:
        """The cubes on each body, and the depth of all. ConfigError: they do not fit."""
        model, mujoco, skin = self.model, self._mujoco, self.skin
        still = mujoco.MjData(model)
        mujoco.mj_kinematics(model, still)
        base = self._body(skin.parent_frame)
        if base < 0:
            names = [model.body(number).name for number in range(model.nbody)]
            raise ConfigError(
                f"the MuJoCo model has no body {skin.parent_frame}, which is the parent_frame of "
                f"skin {skin.name}; its bodies are {', '.join(filter(None, names))}"
            )
        on = np.array([max(self._body(cube.link), -1) for cube in skin.cubes])
        on[on < 0] = base
        origin, axes = still.xpos[base], still.xmat[base].reshape(3, 3)
        depth = np.empty(len(on))
        for number, cube in enumerate(skin.cubes):
            place = origin + axes @ self.poses.position[number]
            outward = axes @ self.poses.rotation[number, :, 2]
            depth[number] = self._surface(still, int(on[number]), place, outward, cube)
        middle = float(np.median(depth))
        far = int(np.argmax(np.abs(depth - middle)))
        if abs(depth[far] - middle) > SAME_DEPTH * middle:
            raise ConfigError(
                f"skin {skin.name} does not fit the MuJoCo model: cube {skin.cubes[far].name} lies "
                f"{1e3 * depth[far]:.3g} mm below the surface, the others {1e3 * middle:.3g} mm; "
                f"all must have one depth to {SAME_DEPTH:.0%}: move cubes or geoms"
            )
        parts = []
        for body in np.unique(on).tolist():
            cubes = np.flatnonzero(on == body)
            poses = CubePoses(*(column[cubes] for column in self.poses))
            rotation = axes.T @ still.xmat[body].reshape(3, 3)
            position = axes.T @ (still.xpos[body] - origin)
            parts.append(_Part(body, cubes, poses, poses.pitch, rotation, position))
        return parts, middle

    def _body(self, name: str | None) -> int:
        """Its number, -1 where there is none."""
        kind = self._mujoco.mjtObj.mjOBJ_BODY
        return -1 if name is None else self._mujoco.mj_name2id(self.model, kind, name)

    def _surface(
        self, still: MjData, body: int, place: Array, outward: Array, cube: SkinCube
    ) -> float:
        """Distance in m from a cube to the surface of its body's geoms that collide, in the world
        frame of `still`. ConfigError: there is none."""
        model, mujoco = self.model, self._mujoco
        first = model.body_geomadr[body]
        found = []
        for geom in range(first, first + model.body_geomnum[body]):
            if not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
                continue
            kind = model.geom_type[geom]
            if kind == mujoco.mjtGeom.mjGEOM_MESH:
                found.append(mujoco.mj_rayMesh(model, still, geom, place, outward))
            else:
                frame = still.geom_xpos[geom], still.geom_xmat[geom], model.geom_size[geom]
                found.append(mujoco.mju_rayGeom(*frame, place, outward, kind))
        found = [distance for distance in found if distance > 0]
        if not found:
            raise ConfigError(
                f"skin {self.skin.name} does not fit the MuJoCo model: no geom of body "
                f"{model.body(body).name} that collides is above cube {cube.name} along its z "
                "axis; move the cube in the skin file, or the geom in the model"
            )
        return min(found)


@lru_cache(maxsize=8)
def _tables(layer: Layer, depth: float) -> tuple[DiscTables, PolygonTables]:
    """Kept: the skins of a robot are often alike."""
    return DiscTables(layer, depth), PolygonTables(layer, depth)


def _under_discs(part: _Part, presses: list[Press], tables: DiscTables) -> tuple[Array, Array]:
    """Stress and gradient at the cubes of a part under round contacts."""
    position, rotation, _ = part.poses
    facing = np.maximum(rotation[:, :, 2] @ np.stack([press.normal for press in presses], 1), 0.0)
    place = (position[:, None] - [press.position for press in presses]) @ rotation
    force = np.stack([press.force for press in presses]) @ rotation * facing[..., None]
    return tables.field(place[..., :2], force, [press.radius for press in presses])


def _under_polygons(
    part: _Part, flat: list[tuple[Polygon, Array]], tables: PolygonTables
) -> tuple[Array, Array]:
    """Stress and gradient at the cubes of a part under polygons and their normals.

    A polygon is laid flat on a cube's plane, which leaves the part of its area by which it faces
    the cube.
    """
    position, rotation, _ = part.poses
    polygons = [polygon for polygon, _ in flat]
    following: list[int] = []  # the number of the corner where each edge ends
    number: list[int] = []  # the edge's polygon
    for one, polygon in enumerate(polygons):
        first, size = len(number), len(polygon.corners)
        following += [*range(first + 1, first + size), first]
        number += [one] * size
    places = np.concatenate([polygon.corners for polygon in polygons])
    corners = (places - position[:, None]) @ rotation[..., :2]
    centre = (np.stack([one.centre for one in polygons]) - position[:, None]) @ rotation[..., :2]
    facing = np.maximum(rotation[:, :, 2] @ np.stack([normal for _, normal in flat], axis=1), 0.0)
    twist = facing * [polygon.twist for polygon in polygons]
    traction = np.stack([polygon.traction for polygon in polygons]) @ rotation
    traction *= (facing > 0)[..., None]
    traction[..., 0] += twist * centre[..., 1]
    traction[..., 1] -= twist * centre[..., 0]
    return tables.field(corners, corners[:, following], traction[:, number], twist[:, number])


def _curvatures(model: MjModel, mujoco: Any) -> Array:
    """(geoms + 1,) 1/m, of spheres and of what is round with one radius; 0 for all that is flat.

    The last is that of what is no geom.
    """
    kinds = mujoco.mjtGeom
    round_ones = (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER)
    is_round = np.isin(model.geom_type, [int(kind) for kind in round_ones])
    size = np.where(is_round, model.geom_size[:, 0], 1.0)
    return np.append(np.where(is_round, 1 / size, 0.0), 0.0)
