# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A skin on the bodies of a MuJoCo model: contact forces become tractions, and stress at the cubes.

Example::

    import mujoco
    from cube_tensor_driver.simulation.mujoco.source import MujocoSkin

    model = mujoco.MjModel.from_xml_path("robot.xml")
    data = mujoco.MjData(model)
    touch = MujocoSkin(model, data, ctd.read_skin("skin.yaml"))
    while True:
        mujoco.mj_step(model, data)
        rows = touch.read()

The skin sits on the body that has the name of its parent frame. Cubes whose link has the name of
another body sit on that one, so that the two fingers of a hand can be one skin. The poses of the
skin file hold in the reference configuration of the model (qpos0). The surface is that of the
bodies' geoms above the cubes.

The stress at each cube is that in a layer whose surface lies `depth` above the cube, perpendicular
to its z axis, as in `load.py`. patches.py converts contact points to tractions, and
mechanics/contact_tables.py computes the stress at the cubes from them. Contacts on the side of a
body that no cube faces cause no stress. MuJoCo determines the damping of contacts.

MuJoCo is the extra `mujoco` of this package. It is imported when a skin is created.
"""

from __future__ import annotations

import math
from collections import defaultdict
from functools import lru_cache
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...config.skin import Skin, SkinCube
from ...core.arrays import Array, Index
from ...core.defaults import POISSONS_RATIO, YOUNGS_MODULUS
from ...core.errors import ConfigError
from ...core.poses import CubePoses
from ...core.reconstructor import Reconstructor
from ...core.rows import FrequencyRows, StressRows
from ...mechanics.contact_tables import DiscTables, PolygonTables
from ...mechanics.layer import Layer
from ..cubes import PadErrors
from ..imperfections import NONE, Imperfections
from ..load import ContactLoad, StressField, compute_surface_normal
from ..source import SkinPads
from .patches import Polygon, compute_hertz_radius, find_next_corners, make_flat_contact

if TYPE_CHECKING:
    from mujoco import MjData, MjModel


MAX_DEPTH_DEVIATION = 0.1
"""Largest allowed deviation of the depth of a cube below the surface from the median depth of all
cubes, divided by the median. The stress of all cubes is computed for the median."""

MIN_WIDTH_DEPTHS = 0.3
"""Smallest width of the contact of a flat body, divided by the depth of the cubes. A body that
touches along a line or at an edge gets this width."""


def load_mujoco() -> ModuleType:
    """Import the module mujoco.

    Raises:
        ConfigError: It is not installed.
    """
    try:
        return import_module("mujoco")
    except ModuleNotFoundError:
        raise ConfigError(
            "MuJoCo is not installed: pip install 'cube-tensor-driver[mujoco]', or pip install "
            "mujoco in the environment of this program"
        ) from None


class _BodyCubes(NamedTuple):
    """The cubes on one body of the MuJoCo model.

    Attributes:
        body: Number of the body.
        cubes: Indices (n,) of the cubes in the skin.
        poses: Poses of these cubes in the parent frame of the skin.
        pitch: Typical distance of neighbouring cubes in m.
        rotation: Rotation (3, 3) from the body's frame to the parent frame.
        position: Origin (3,) of the body's frame in the parent frame, in m.
    """

    body: int
    cubes: Index
    poses: CubePoses
    pitch: float
    rotation: Array
    position: Array


class BodyContact(NamedTuple):
    """One contact of a skin, in the skin's parent frame.

    Attributes:
        body: Number of the body that is touched.
        press: Round contact with the force, centre and area of this contact.
        polygon: Traction on a polygon if the contact is flat; None if it is round.
    """

    body: int
    press: ContactLoad
    polygon: Polygon | None = None


class MujocoSkin:
    """The cubes of a skin as a sensor of a MuJoCo model.

    Attributes:
        model: MuJoCo's model.
        data: MuJoCo's state, which is read after each step.
        skin: The skin.
        poses: Poses of the cubes in the skin's parent frame.
        depth: Distance in m from the centres of the cubes to the surface of the model.
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
        """Attach the cubes to the bodies, which takes seconds the first time.

        Args:
            model: MuJoCo's model.
            data: MuJoCo's state.
            skin: Skin on its bodies.
            thickness: Thickness of the elastomer on rigid ground, in m; infinite for a half space.
            young: Young's modulus of the elastomer in Pa, which determines how wide round contacts
                are.
            poisson: Poisson's ratio of the elastomer.
            noise: Standard deviation of a frequency divided by the frequency; None: that of the
                calibration of each cube.
            drift: Relative change of every rest frequency (frequency without load) per second.
            imperfections: Deviations of the pads from their calibrations; None: none.

        Raises:
            ConfigError: MuJoCo is not installed, no body of the model has the name of the skin's
                parent frame, or a cube does not lie below the surface of its body.
            ElasticError: Thickness or Poisson's ratio is out of range, or the cubes lie deeper than
                the layer.
        """
        self._mujoco = load_mujoco()
        self.model = model
        self.data = data
        self.skin = skin
        self.poses = skin.poses
        self._parts, self.depth = self._attach()
        # The depth is rounded to µm, so that skins whose depths differ only by rounding errors
        # share their tables.
        layer = Layer(thickness, poisson)
        self._discs, self._polygons = _make_tables(layer, round(self.depth, 6))
        self._stiffness = young / (1 - poisson**2)
        kinds = self._mujoco.mjtGeom
        round_kinds = (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER)
        self._round_kinds = {int(kind) for kind in round_kinds}
        self._pads = SkinPads(skin, PadErrors(noise, drift, imperfections or NONE))
        self._reconstructor = Reconstructor(skin)
        self._scans = 0

    def read(self) -> StressRows:
        """Return stress and gradient of all cubes in the state of `data`; call it after mj_step."""
        return self._reconstructor.process(self.frequencies())

    def frequencies(self) -> FrequencyRows:
        """Return the frequencies of all pads in the state of `data`, with its time as stamp."""
        stress, gradient = self.field(self.touches())
        self._scans += 1
        return self._pads.compute_rows(
            stress,
            gradient,
            self._scans - 1,
            round(1e6 * self.data.time),
        )

    def touches(self) -> list[BodyContact]:
        """Return all contacts of the skin in the state of `data`."""
        # Numbers of the contact points in MuJoCo's list for each pair of bodies. The key has the
        # body of the skin, whether it is the first (0) or the second (1) of the two bodies, and the
        # geom (shape) that touches it.
        pairs = defaultdict(list)
        geoms = self.data.contact.geom[: self.data.ncon]
        for row, (first, second) in enumerate(geoms.tolist()):
            for side, own, other in ((0, first, second), (1, second, first)):
                # A flexible body has no geom: its number is negative.
                body = self.model.geom_bodyid[own] if own >= 0 else -1
                if body in self._parts:
                    pairs[int(body), side, other].append(row)
        found = [
            self._find_touch(self._parts[body], np.array(rows), side)
            for (body, side, _), rows in sorted(pairs.items())
        ]
        return [touch for touch in found if touch is not None]

    def field(self, touches: list[BodyContact]) -> StressField:
        """Compute stress and gradient at the cubes under contacts.

        Args:
            touches: Contacts of the skin, as `touches` returns them.

        Returns:
            Stress (cubes, 6) in Pa and gradient (cubes, 6, 3) in Pa/m, order xx yy zz yz zx xy, in
            the frames of the cubes.
        """
        n = len(self.poses.position)
        stress = np.zeros((n, 6))
        gradient = np.zeros((n, 6, 3))
        # A contact causes stress only at the cubes of the body that is touched.
        for part in self._parts.values():
            own = [touch for touch in touches if touch.body == part.body]
            discs = [touch.press for touch in own if touch.polygon is None]
            flat = [touch for touch in own if touch.polygon is not None]
            fields = [_compute_field_of_discs(part, discs, self._discs)] if discs else []
            if flat:
                fields.append(_compute_field_of_polygons(part, flat, self._polygons))
            for part_stress, part_gradient in fields:
                stress[part.cubes] += part_stress
                gradient[part.cubes] += part_gradient
        return stress, gradient

    def _find_touch(
        self,
        part: _BodyCubes,
        rows: Index,
        side: int,
    ) -> BodyContact | None:
        """Return the contact of one pair of bodies; None if no force presses on the skin's surface.

        Args:
            part: Body of the skin and its cubes.
            rows: Numbers (n,) of the contact points of the pair in MuJoCo's list.
            side: 0 if the body with the skin is the first of the two bodies, 1 if it is the second.
                MuJoCo's contact forces act on the second one.
        """
        # MuJoCo's normal points from the first body to the second one.
        sign = 2 * side - 1
        place, force, outward = self._find_contact_points(part, rows, sign)
        normal = compute_surface_normal(
            part.poses,
            part.pitch,
            place.mean(axis=0),
        )
        is_felt = (outward @ normal > 0) & (force @ normal < 0)
        if not is_felt.any():
            return None

        place, force = place[is_felt], force[is_felt]
        total = force.sum(axis=0)
        pressing = -float(total @ normal)
        if len(place) > 1:
            # A round contact of the same area also describes this flat contact, for callers that
            # need only its centre and force.
            polygon = make_flat_contact(
                place,
                force,
                normal,
                MIN_WIDTH_DEPTHS * self.depth,
            )
            pressure = -float(polygon.traction @ normal)
            radius = math.sqrt(pressing / pressure / math.pi)
            load = ContactLoad(
                "disc",
                polygon.centre,
                normal,
                total,
                radius,
            )
            return BodyContact(part.body, load, polygon)
        # For a Hertz contact, the curvatures (1 / radius) of both bodies add up (Johnson 4.2).
        # Shapes other than sphere, capsule and cylinder count as flat, with the curvature 0.
        model = self.model
        curvature = sum(
            1 / model.geom_size[geom, 0]
            for geom in self.data.contact.geom[rows[0]].tolist()
            if geom >= 0 and model.geom_type[geom] in self._round_kinds
        )
        radius = compute_hertz_radius(pressing, curvature, self._stiffness)
        return BodyContact(
            part.body,
            ContactLoad(
                "sphere",
                place[0],
                normal,
                total,
                radius,
            ),
        )

    def _find_contact_points(
        self,
        part: _BodyCubes,
        rows: Index,
        sign: int,
    ) -> tuple[Array, Array, Array]:
        """Return the positions in m, forces in N and normals (each (n, 3)) of n contact points.

        They are in the parent frame of the skin. The forces act on the skin, and the normals point
        out of the skin.

        Args:
            part: Body of the skin and its cubes.
            rows: Numbers (n,) of the contact points in MuJoCo's list.
            sign: 1 if the body of the skin is the second of the two bodies, -1 if it is the first.
        """
        data = self.data
        frames = data.contact.frame[rows].reshape(-1, 3, 3)
        in_frames = np.empty((len(rows), 3))
        wrench = np.empty(6)
        for number, row in enumerate(rows.tolist()):
            self._mujoco.mj_contactForce(self.model, data, row, wrench)
            in_frames[number] = wrench[:3]  # the moments of a point are left out

        body_rotation = data.xmat[part.body].reshape(3, 3)
        to_parent = part.rotation @ body_rotation.T
        offset = data.contact.pos[rows] - data.xpos[part.body]
        place = offset @ to_parent.T + part.position
        in_world = np.einsum("nj,njk->nk", in_frames, frames)
        force = sign * in_world @ to_parent.T
        outward = -sign * frames[:, 0] @ to_parent.T
        return place, force, outward

    def _attach(self) -> tuple[dict[int, _BodyCubes], float]:
        """Find the body and the depth of each cube.

        Returns:
            Number of a body -> its cubes; and the depth of all cubes in m.

        Raises:
            ConfigError: The skin does not fit the model.
        """
        model = self.model
        skin = self.skin
        reference = self._mujoco.MjData(model)
        self._mujoco.mj_kinematics(model, reference)
        base = self._find_body_number(skin.parent_frame)
        if base < 0:
            numbers = range(model.nbody)
            names = [model.body(number).name for number in numbers]
            raise ConfigError(
                f"the MuJoCo model has no body {skin.parent_frame}, which is the parent_frame of "
                f"skin {skin.name}; its bodies are {', '.join(filter(None, names))}"
            )
        # A cube whose link does not have the name of a body is on the body of the parent frame.
        bodies = np.array([self._find_body_number(cube.link) for cube in skin.cubes])
        bodies[bodies < 0] = base

        origin = reference.xpos[base]
        axes = reference.xmat[base].reshape(3, 3)
        places = origin + self.poses.position @ axes.T
        outward = self.poses.rotation[:, :, 2] @ axes.T
        depth = np.array(
            [
                self._measure_distance_to_surface(reference, *cube)
                for cube in zip(
                    bodies.tolist(),
                    places,
                    outward,
                    skin.cubes,
                    strict=True,
                )
            ]
        )
        # One table of stresses serves all cubes, so their depths must be nearly equal.
        median = float(np.median(depth))
        deviation = np.abs(depth - median)
        wrong = int(np.argmax(deviation))
        if deviation[wrong] > MAX_DEPTH_DEVIATION * median:
            raise ConfigError(
                f"skin {skin.name} does not fit the MuJoCo model: cube {skin.cubes[wrong].name} "
                f"lies {1e3 * depth[wrong]:.3g} mm below the surface, the others "
                f"{1e3 * median:.3g} mm; all must have one depth to {MAX_DEPTH_DEVIATION:.0%}: "
                "move cubes or geoms"
            )

        parts = {}
        for body in np.unique(bodies).tolist():
            cubes = np.flatnonzero(bodies == body)
            poses = CubePoses(*(column[cubes] for column in self.poses))
            to_world = reference.xmat[body].reshape(3, 3)
            parts[body] = _BodyCubes(
                body,
                cubes,
                poses,
                poses.pitch,
                rotation=axes.T @ to_world,
                position=axes.T @ (reference.xpos[body] - origin),
            )
        return parts, median

    def _find_body_number(self, name: str | None) -> int:
        """Return the number of a body, -1 if there is none of this name."""
        if name is None:
            return -1
        kind = self._mujoco.mjtObj.mjOBJ_BODY
        number: int = self._mujoco.mj_name2id(self.model, kind, name)
        return number

    def _measure_distance_to_surface(
        self,
        reference: MjData,
        body: int,
        place: Array,
        outward: Array,
        cube: SkinCube,
    ) -> float:
        """Return the distance in m from a cube to the nearest colliding geom (shape) of its body.

        Args:
            reference: State in the reference configuration.
            body: Number of the body.
            place: Position (3,) of the cube in the world, in m.
            outward: z axis (3,) of the cube in the world.
            cube: The cube, for error messages.

        Raises:
            ConfigError: There is no geom above the cube.
        """
        model = self.model
        mujoco = self._mujoco
        first = model.body_geomadr[body]
        distances = []
        for geom in range(first, first + model.body_geomnum[body]):
            kind = model.geom_type[geom]
            if not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
                distance = -1.0  # it does not collide
            elif kind == mujoco.mjtGeom.mjGEOM_MESH:
                distance = mujoco.mj_rayMesh(
                    model,
                    reference,
                    geom,
                    place,
                    outward,
                )
            else:
                distance = mujoco.mju_rayGeom(
                    reference.geom_xpos[geom],
                    reference.geom_xmat[geom],
                    model.geom_size[geom],
                    place,
                    outward,
                    kind,
                )
            if distance > 0:
                distances.append(float(distance))
        if not distances:
            raise ConfigError(
                f"skin {self.skin.name} does not fit the MuJoCo model: no geom of body "
                f"{model.body(body).name} that collides is above cube {cube.name} along its z "
                "axis; move the cube in the skin file, or the geom in the model"
            )
        return min(distances)


@lru_cache(maxsize=8)
def _make_tables(
    layer: Layer,
    depth: float,
) -> tuple[DiscTables, PolygonTables]:
    """Return the tables of the stress under discs and polygons in a layer of elastomer.

    They are cached, because the skins of a robot often have the same layer and depth.

    Args:
        layer: Thickness and Poisson's ratio of the layer.
        depth: Depth of the cubes below the surface, in m.
    """
    return DiscTables(layer, depth), PolygonTables(layer, depth)


def _compute_field_of_discs(
    part: _BodyCubes,
    loads: list[ContactLoad],
    tables: DiscTables,
) -> StressField:
    """Compute stress and gradient at the cubes of a body under round contacts.

    Args:
        part: The cubes on the body.
        loads: Round contacts, in the parent frame of the skin.
        tables: Stress under discs, for the layer and the depth of the cubes.
    """
    position, rotation, _ = part.poses
    _, centres, normals, forces, radii = map(np.array, zip(*loads, strict=True))
    outward = rotation[:, :, 2]
    facing = np.maximum(outward @ normals.T, 0.0)
    # `place` is the position of each cube relative to the centre of each contact, `force` the force
    # of each contact, both in the frame of the cube.
    place = (position[:, None] - centres) @ rotation
    force = forces @ rotation * facing[..., None]
    return tables.compute_field(place[..., :2], force, radii)


def _compute_field_of_polygons(
    part: _BodyCubes,
    touches: list[BodyContact],
    tables: PolygonTables,
) -> StressField:
    """Compute stress and gradient at the cubes of a body under tractions on polygons.

    A polygon is projected onto the plane of a cube, which reduces its area by the cosine of the
    angle between its normal and the normal of the plane.

    Args:
        part: The cubes on the body.
        touches: Flat contacts, in the parent frame of the skin.
        tables: Stress under polygons, for the layer and the depth of the cubes.
    """
    position, rotation, _ = part.poses
    in_plane = rotation[..., :2]
    normals = np.array([touch.press.normal for touch in touches])
    polygons = [touch.polygon for touch in touches if touch.polygon is not None]
    corners, centres, tractions, twists = zip(*polygons, strict=True)
    # Each corner is the start of one edge, the next corner its end.
    starts = np.concatenate(corners)
    ends = np.concatenate([find_next_corners(one) for one in corners])
    n_corners = [len(one) for one in corners]
    number = np.repeat(np.arange(len(polygons)), n_corners)

    origin = position[:, None]
    centre = (np.array(centres) - origin) @ in_plane

    # The twist (circulating traction) of a polygon is given about its centroid. The tables need it
    # about the point of the surface above the cube.
    outward = rotation[:, :, 2]
    facing = np.maximum(outward @ normals.T, 0.0)
    twist = facing * twists
    traction = np.array(tractions) @ rotation
    traction *= (facing > 0)[..., None]
    traction[..., 0] += twist * centre[..., 1]
    traction[..., 1] -= twist * centre[..., 0]
    return tables.compute_field(
        (starts - origin) @ in_plane,
        (ends - origin) @ in_plane,
        traction[:, number],
        twist[:, number],
    )
