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

from .arrays import AnyArray, Array, Real
from .errors import CubeError
from .modes import to_matrix, to_voigt

_FIXED_AXES = "sxyz"  # transforms3d's name for roll, pitch and yaw as URDF and REP 103 define them


def principal_stresses(stress: Real) -> tuple[Array, Array]:
    """Compute principal stresses and their directions.

    Args:
        stress: Stress (..., 6).

    Returns:
        Principal stresses (..., 3), the largest first, and unit vectors (..., 3, 3), one a row. The
        sign of a direction is arbitrary. Rows with NaN give NaN.
    """
    matrices = to_matrix(stress).astype(float)
    is_known = np.isfinite(matrices).all(axis=(-2, -1))
    # LAPACK raises an error for NaN, so unknown rows are computed as zero and replaced below.
    matrices[~is_known] = 0
    ascending, vectors = np.linalg.eigh(matrices)
    values = ascending[..., ::-1].copy()
    # LAPACK returns vectors as columns.
    rows = np.swapaxes(vectors, -1, -2)
    directions = rows[..., ::-1, :].copy()
    values[~is_known] = np.nan
    directions[~is_known] = np.nan
    return values, directions


def invariants(stress: Real) -> Array:
    """Compute the invariants (..., 3) of a stress (..., 6) in Pa.

    They are I1 = tr s in Pa, I2 = (I1^2 - tr s^2) / 2 in Pa^2 and I3 = det s in Pa^3.
    """
    xx, yy, zz, yz, zx, xy = _split(stress)
    trace = xx + yy + zz
    minors = xx * yy + yy * zz + zz * xx - yz**2 - zx**2 - xy**2
    determinant = xx * yy * zz + 2 * yz * zx * xy - xx * yz**2 - yy * zx**2 - zz * xy**2
    return np.stack([trace, minors, determinant], axis=-1)


def von_mises(stress: Real) -> Array:
    """Compute the von Mises stress (...), sqrt(3/2 |deviator|^2), of a stress (..., 6)."""
    xx, yy, zz, yz, zx, xy = _split(stress)
    normal = (xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2
    shear = yz**2 + zx**2 + xy**2
    result: Array = np.sqrt(normal / 2 + 3 * shear)
    return result


def _split(stress: Real) -> AnyArray:
    """Return the components (6, ...) of a stress (..., 6)."""
    return np.moveaxis(np.asarray(stress), -1, 0)


def traction(stress: Real, normal: ArrayLike) -> Array:
    """Compute the traction sigma n (..., 3) on planes.

    Args:
        stress: Stress (..., 6).
        normal: Normals of the planes (..., 3) of any length but 0.

    Raises:
        CubeError: A normal has length 0.
    """
    n = np.asarray(normal, dtype=float)
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    if not np.all(length > 0):
        raise CubeError(
            f"traction: normal {n.tolist()} has length 0; give the direction of the plane's normal"
        )
    matrices: AnyArray = to_matrix(stress)
    result: Array = np.einsum("...ij,...j->...i", matrices, n / length)
    return result


def rotate_stress(stress: Real, rotation: ArrayLike) -> Array:
    """Compute the stress R s R' (..., 6) in a frame with the coordinates R x. NaN spreads."""
    r = np.asarray(rotation, dtype=float)
    inverse = np.swapaxes(r, -1, -2)
    rotated: Array = r @ to_matrix(stress) @ inverse
    return to_voigt(rotated)


def rotate_gradient(gradient: Array, rotation: ArrayLike) -> Array:
    """Compute the gradient R_ia R_jb R_kc G_abc (..., 3, 3, 3) in a frame with the coordinates R x.

    All 27 entries are needed, because the nine normal gradients in a rotated frame depend on
    gradients of shear in the first frame.
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
    """Return Rz(yaw) Ry(pitch) Rx(roll) (3, 3) of angles in rad, fixed axes as in URDF.

    It takes coordinates of the cube to those of its parent frame.
    """
    rotation: Array = euler.euler2mat(roll, pitch, yaw, _FIXED_AXES)
    return rotation


def quaternion_from_rpy(
    roll: float,
    pitch: float,
    yaw: float,
) -> Array:
    """Return the quaternion x, y, z, w (4,) of `rotation_from_rpy`, with w not negative."""
    w, x, y, z = euler.euler2quat(roll, pitch, yaw, _FIXED_AXES)
    # Both signs are the same rotation; choosing one makes equal rotations equal numbers.
    sign = 1 if w >= 0 else -1
    return np.array([x, y, z, w]) * sign


def quaternion_from_rotation(rotation: Array) -> Array:
    """Return the quaternion x, y, z, w (4,) of a rotation matrix (3, 3), with w not negative."""
    matrix = np.asarray(rotation, dtype=float)
    w, x, y, z = quaternions.mat2quat(matrix)
    return np.array([x, y, z, w])


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion x, y, z, w of any length but 0.

    Raises:
        CubeError: The quaternion is zero or not finite.
    """
    x, y, z, w = np.asarray(quaternion, dtype=float)
    length = np.sqrt(x * x + y * y + z * z + w * w)
    if not (np.isfinite(length) and length > 0):
        raise CubeError(
            f"quaternion {[x, y, z, w]} has length {length}; it must be finite and above 0"
        )
    rotation: Array = quaternions.quat2mat([w, x, y, z])
    return rotation


def rpy_from_quaternion(quaternion: ArrayLike) -> Array:
    """Return roll, pitch and yaw (3,), in rad, of a quaternion x, y, z, w.

    Raises:
        CubeError: The quaternion is zero or not finite.
    """
    angles = euler.mat2euler(rotation_from_quaternion(quaternion), _FIXED_AXES)
    return np.array(angles)


def face_force(stress: Real, side: Array | float) -> Array:
    """Compute the force w^2 sigma n on a square in the plane of the face +z.

    Args:
        stress: Stress (N, 6), in Pa. Components that are not observed count as 0.
        side: Side w of the square, in m.

    Returns:
        Force (N, 3) in the frame of the stress, in N.
    """
    zx_yz_zz = [4, 3, 2]
    traction: AnyArray = np.nan_to_num(stress)[..., zx_yz_zz]
    force: Array = side**2 * traction
    return force


def contact_wrench(
    stress: Real,
    gradient: Real,
    side: float,
) -> tuple[Array, Array]:
    """Compute force and torque on a square in the plane of the face +z.

        force  = w^2 sigma n
        torque = (w^4 / 12) (d(szz)/dy, -d(szz)/dx, 0)

    The torque about z needs gradients of shear, to which pads of normal stress do not respond, so
    it is 0. Components that are not observed count as 0.

    Args:
        stress: Stress (N, 6), in Pa.
        gradient: Gradients of the normal stresses (N, 9) as in `StressRows`, in Pa/m.
        side: Side w of the square, in m.

    Returns:
        Force (N, 3) in N and torque (N, 3) in N m.
    """
    known: AnyArray = np.nan_to_num(gradient)
    zz_x, zz_y = known[..., 6], known[..., 7]
    unknown_twist = np.zeros_like(zz_x)
    direction = np.stack([zz_y, -zz_x, unknown_twist], axis=-1)
    # A pressure that grows linearly over the square turns about its centre, as in a bent beam.
    second_moment_of_area = side**4 / 12
    return face_force(stress, side), second_moment_of_area * direction
