# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Tensor algebra over rows: invariants, tractions, rotations and forces of stress tensors.

A stress (..., 6) has the components xx, yy, zz, yz, zx, xy (Voigt order), tension positive. A
gradient is (..., 3, 3, 3) with G_ijk = d(sigma_ij)/dx_k. Where no unit is stated, any unit will do.

Source: textbook continuum mechanics. Rotations are computed by transforms3d; quaternions have the
order of ROS: x, y, z, w.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from transforms3d import euler, quaternions

from .arrays import Array, Real
from .errors import CubeError
from .modes import to_matrix, to_voigt

TRACTION_COMPONENTS = [4, 3, 2]
"""Columns of a stress (N, 6) in the order xx, yy, zz, yz, zx, xy whose components act on the face
+z of a cube: zx, yz and zz."""

_FIXED_AXES = "sxyz"
"""Name by which the library transforms3d means roll, pitch and yaw about fixed axes, as in URDF and
REP 103."""


def compute_principal_stresses(stress: Real) -> tuple[Array, Array]:
    """Compute principal stresses and their directions.

    Args:
        stress: Stress (..., 6) in any unit, in the order xx, yy, zz, yz, zx, xy.

    Returns:
        Principal stresses (..., 3), the largest first, and their directions as the rows of
        matrices (..., 3, 3). The sign of a direction is arbitrary. A stress with a NaN gives NaN.
    """
    is_known = np.isfinite(stress).all(axis=-1)
    matrices = to_matrix(stress).astype(float)
    # LAPACK raises an error for NaN, so unknown rows are computed as zero and replaced below.
    matrices[~is_known] = 0
    ascending, vectors = np.linalg.eigh(matrices)
    values = ascending[..., ::-1].copy()
    # LAPACK returns the eigenvectors as columns and in ascending order of the eigenvalues.
    rows = np.swapaxes(vectors, -1, -2)
    directions = rows[..., ::-1, :].copy()
    values[~is_known] = np.nan
    directions[~is_known] = np.nan
    return values, directions


def compute_invariants(stress: Real) -> Array:
    """Compute the invariants I1, I2, I3 (..., 3) of a stress tensor s (..., 6) in Pa.

    I1 = tr s in Pa, I2 = (I1^2 - tr s^2) / 2 in Pa^2, and I3 = det s in Pa^3.
    """
    matrices = to_matrix(stress).astype(float)
    trace = np.trace(matrices, axis1=-2, axis2=-1)
    trace_of_square = np.einsum("...ij,...ij->...", matrices, matrices)
    second = (trace**2 - trace_of_square) / 2
    return np.stack([trace, second, np.linalg.det(matrices)], axis=-1)


def compute_von_mises(stress: Real) -> Array:
    """Compute the von Mises stress ``sqrt(3/2 |deviator|^2)`` of each stress tensor (..., 6).

    The deviator is the tensor minus the mean of its normal stresses. The result has the unit of the
    stress.
    """
    matrices = to_matrix(stress).astype(float)
    mean = np.trace(matrices, axis1=-2, axis2=-1) / 3
    deviator = matrices - mean[..., None, None] * np.eye(3)
    square = np.einsum("...ij,...ij->...", deviator, deviator)
    result: Array = np.sqrt(1.5 * square)
    return result


def compute_traction(stress: Real, normal: ArrayLike) -> Array:
    """Compute the traction sigma n (force per area on a plane), in the unit of the stress (..., 3).

    Args:
        stress: Stress (..., 6).
        normal: Normals of the planes (..., 3), of any length but 0; they are normalised.

    Raises:
        CubeError: A normal has length 0.
    """
    n = np.asarray(normal, dtype=float)
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    if not np.all(length > 0):
        raise CubeError(
            f"traction: normal {n.tolist()} has length 0; give the direction of the plane's normal"
        )
    unit_normal = n / length
    matrices: Real = to_matrix(stress)
    result: Array = np.einsum("...ij,...j->...i", matrices, unit_normal)
    return result


def rotate_stress(stress: Real, rotation: ArrayLike) -> Array:
    """Compute the stress R s R' (..., 6) in a rotated frame.

    Args:
        stress: Stress s (..., 6). A NaN in one component makes every component of the result NaN
            that depends on it.
        rotation: Matrix R (..., 3, 3) that takes coordinates x to R x in the rotated frame.
    """
    r = np.asarray(rotation, dtype=float)
    inverse = np.swapaxes(r, -1, -2)
    rotated: Array = r @ to_matrix(stress) @ inverse
    return to_voigt(rotated)


def rotate_gradient(gradient: Array, rotation: ArrayLike) -> Array:
    """Compute the stress gradient R_ia R_jb R_kc G_abc (..., 3, 3, 3) in a rotated frame.

    All 27 entries are needed, because gradients of normal stress in the rotated frame depend on
    gradients of shear stress in the first frame.

    Args:
        gradient: Gradient G_abc = d(sigma_ab)/dx_c (..., 3, 3, 3).
        rotation: Matrix R (..., 3, 3) that takes coordinates x to R x in the rotated frame.
    """
    r = np.asarray(rotation, dtype=float)
    g = np.asarray(gradient)
    rotated: Array = np.einsum("...ia,...jb,...kc,...abc->...ijk", r, r, r, g)
    return rotated


def rotation_from_rpy(
    roll: float,
    pitch: float,
    yaw: float,
) -> Array:
    """Return the rotation matrix Rz(yaw) Ry(pitch) Rx(roll) (3, 3).

    If the angles state the orientation of a frame in its parent frame, as in URDF, the matrix takes
    coordinates in the frame to coordinates in the parent frame.

    Args:
        roll: Rotation about the x axis of the parent frame, in rad.
        pitch: Rotation about its y axis after that, in rad.
        yaw: Rotation about its z axis after that, in rad.
    """
    rotation: Array = euler.euler2mat(roll, pitch, yaw, _FIXED_AXES)
    return rotation


def quaternion_from_rpy(
    roll: float,
    pitch: float,
    yaw: float,
) -> Array:
    """Return the rotation by roll, pitch and yaw as a quaternion x, y, z, w (4,) with w >= 0.

    Args:
        roll: First rotation, about the fixed x axis, in rad.
        pitch: Second rotation, about the fixed y axis, in rad.
        yaw: Third rotation, about the fixed z axis, in rad.
    """
    w, x, y, z = euler.euler2quat(roll, pitch, yaw, _FIXED_AXES)
    # q and -q are the same rotation; choosing one sign gives equal rotations equal numbers.
    sign = 1 if w >= 0 else -1
    return np.array([x, y, z, w]) * sign


def quaternion_from_rotation(rotation: Array) -> Array:
    """Return the quaternion x, y, z, w (4,), with w >= 0, of a rotation matrix (3, 3)."""
    matrix = np.asarray(rotation, dtype=float)
    w, x, y, z = quaternions.mat2quat(matrix)
    return np.array([x, y, z, w])


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion x, y, z, w of any length but 0.

    Raises:
        CubeError: The quaternion is zero or not finite.
    """
    x, y, z, w = np.asarray(quaternion, dtype=float)
    square = x * x + y * y + z * z + w * w
    length = np.sqrt(square)
    if not (np.isfinite(length) and length > 0):
        raise CubeError(
            f"quaternion {[x, y, z, w]} has length {length}; it must be finite and above 0"
        )
    rotation: Array = quaternions.quat2mat([w, x, y, z])
    return rotation


def rpy_from_quaternion(quaternion: ArrayLike) -> Array:
    """Return roll, pitch and yaw (3,), in rad, of the rotation by a quaternion x, y, z, w (4,).

    Raises:
        CubeError: The quaternion is zero or not finite.
    """
    angles = euler.mat2euler(rotation_from_quaternion(quaternion), _FIXED_AXES)
    return np.array(angles)


def compute_face_force(stress: Real, side: Array | float) -> Real:
    """Compute the force w^2 sigma n on a square whose normal n is +z.

    Args:
        stress: Stress (N, 6), in Pa. NaN (a component that is not known) counts as 0.
        side: Side w of the square, in m.

    Returns:
        Force (N, 3) in the frame of the stress, in N.
    """
    traction: Real = np.nan_to_num(stress)[..., TRACTION_COMPONENTS]
    return side**2 * traction


def compute_contact_wrench(
    stress: Real,
    gradient: Real,
    side: float | Array,
) -> tuple[Real, Array]:
    """Compute the force and the torque about the centre of a square whose normal n is +z.

        force  = w^2 sigma n
        torque = (w^4 / 12) (d(szz)/dy, -d(szz)/dx, 0)

    The torque about z is returned as 0, because it would need gradients of shear stress, which are
    not among the published components. NaN (a component that is not known) counts as 0.

    Args:
        stress: Stress (N, 6), in Pa.
        gradient: Gradients of the normal stresses (N, 9), in Pa/m: xx, yy and zz, each with its
            derivatives along x, y and z.
        side: Side w of the square, in m.

    Returns:
        Force (N, 3) in N and torque (N, 3) in N m.
    """
    known: Array = np.nan_to_num(gradient)
    zz_x = known[..., 6]
    zz_y = known[..., 7]
    unknown_twist = np.zeros_like(zz_x)
    direction = np.stack([zz_y, -zz_x, unknown_twist], axis=-1)
    # A normal stress that grows linearly over the square causes a torque, as in a bent beam.
    second_moment_of_area = side**4 / 12
    return compute_face_force(stress, side), second_moment_of_area * direction
