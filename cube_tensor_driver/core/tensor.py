"""Tensor algebra over rows. Stress (..., 6) in the order xx, yy, zz, yz, zx, xy, tension positive.

Gradients are (..., 3, 3, 3), G_ijk = d(sigma_ij)/dx_k. Any unit unless said. Source: textbook
continuum mechanics; rotations by transforms3d, quaternions in ROS order x, y, z, w.
"""

from __future__ import annotations

import numpy as np
from transforms3d import euler, quaternions

from .errors import CubeError
from .modes import to_matrix, to_voigt


def principal_stresses(stress: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal stresses (..., 3), largest first, and directions (..., 3, 3), one vector a row.

    Rows with NaN give NaN. The sign of a direction is arbitrary.
    """
    m = to_matrix(stress).astype(float)
    finite = np.isfinite(m).all(axis=(-2, -1))
    values, vectors = np.linalg.eigh(np.where(finite[..., None, None], m, 0))
    values, directions = values[..., ::-1], np.swapaxes(vectors, -1, -2)[..., ::-1, :]
    return np.where(finite[..., None], values, np.nan), np.where(
        finite[..., None, None], directions, np.nan
    )


def invariants(stress: np.ndarray) -> np.ndarray:
    """(..., 3): I1 = tr s, I2 = (I1^2 - tr s^2) / 2, I3 = det s; units Pa, Pa^2, Pa^3."""
    xx, yy, zz, yz, zx, xy = np.moveaxis(np.asarray(stress), -1, 0)
    second = xx * yy + yy * zz + zz * xx - yz**2 - zx**2 - xy**2
    third = xx * yy * zz + 2 * yz * zx * xy - xx * yz**2 - yy * zx**2 - zz * xy**2
    return np.stack([xx + yy + zz, second, third], axis=-1)


def von_mises(stress: np.ndarray) -> np.ndarray:
    """(...) sqrt(3/2 |deviator|^2), at least 0."""
    xx, yy, zz, yz, zx, xy = np.moveaxis(np.asarray(stress), -1, 0)
    normal = (xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2
    return np.sqrt(normal / 2 + 3 * (yz**2 + zx**2 + xy**2))


def traction(stress: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(..., 3) sigma n on planes with normals (..., 3), made unit vectors; CubeError for a zero
    one."""
    n = np.asarray(normal, dtype=float)
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    if not np.all(length > 0):
        raise CubeError(
            f"traction: normal {n.tolist()} has length 0; give the direction of the plane's normal"
        )
    return np.einsum("...ij,...j->...i", to_matrix(stress), n / length)


def rotate_stress(stress: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(..., 6) of R s R' : the stress in a frame of coordinates R x. NaN spreads."""
    r = np.asarray(rotation, dtype=float)
    return to_voigt(r @ to_matrix(stress) @ np.swapaxes(r, -1, -2))


def rotate_gradient(gradient: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(..., 3, 3, 3) R_ia R_jb R_kc G_abc.

    All 27 are needed: the nine normal gradients alone do not determine themselves in a turned
    frame.
    """
    r = np.asarray(rotation, dtype=float)
    return np.einsum("...ia,...jb,...kc,...abc->...ijk", r, r, r, np.asarray(gradient))


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """(3, 3) Rz(yaw) Ry(pitch) Rx(roll), rad, fixed axes as in URDF: cube coordinates to
    parent's."""
    return euler.euler2mat(roll, pitch, yaw, "sxyz")


def quaternion_from_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """(4,) x, y, z, w of rotation_from_rpy, w not negative."""
    w, x, y, z = euler.euler2quat(roll, pitch, yaw, "sxyz")
    return np.array([x, y, z, w]) * (1 if w >= 0 else -1)


def quaternion_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """(4,) x, y, z, w of a rotation matrix (3, 3), w not negative."""
    w, x, y, z = quaternions.mat2quat(np.asarray(rotation, dtype=float))
    return np.array([x, y, z, w])


def rotation_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) from x, y, z, w of any length but 0; CubeError for a zero or non-finite one."""
    x, y, z, w = np.asarray(quaternion, dtype=float)
    size = np.sqrt(x * x + y * y + z * z + w * w)
    if not (np.isfinite(size) and size > 0):
        raise CubeError(
            f"quaternion {[x, y, z, w]} has length {size}; it must be finite and above 0"
        )
    return quaternions.quat2mat([w, x, y, z])


def rpy_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """(3,) roll, pitch, yaw of a quaternion x, y, z, w; CubeError as rotation_from_quaternion."""
    return np.array(euler.mat2euler(rotation_from_quaternion(quaternion), "sxyz"))


def face_force(stress: np.ndarray, side: np.ndarray | float) -> np.ndarray:
    """(N, 3) w^2 sigma n: the force in N on the square face +z of a reference side in m, in the
    frame of stress (N, 6) Pa. Components that are not observed count as 0."""
    return side**2 * np.nan_to_num(stress)[..., [4, 3, 2]]


def contact_wrench(
    stress: np.ndarray, gradient: np.ndarray, side: float
) -> tuple[np.ndarray, np.ndarray]:
    """Force (N, 3) in N and torque (N, 3) in N m on the square face +z of a reference side in m.

        force  = w^2 sigma n
        torque = (w^4 / 12) (d(szz)/dy, -d(szz)/dx, 0)

    stress: (N, 6) Pa; gradient: (N, 9) Pa/m of the normal stresses, as in StressRows. The twist
    needs gradients of shear, which pads of normal stress do not see, so it is 0. Components that
    are not observed count as 0.
    """
    g = np.nan_to_num(gradient)
    torque = side**4 / 12 * np.stack([g[..., 7], -g[..., 6], np.zeros_like(g[..., 0])], axis=-1)
    return face_force(stress, side), torque
