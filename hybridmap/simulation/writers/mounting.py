"""Headings and mountings as the quaternions that files carry, which read back to the same bits."""

from __future__ import annotations

import numpy as np

from hybridmap.errors import StreamError
from hybridmap.geometry import Array, quaternion_from_yaw, rotation_from_quaternion, yaw_from_quaternion


def quaternion_of_rotation(rotation: Array) -> Array:
    """Quaternion (4,), x y z w, of a rotation matrix (3, 3), so that `rotation_from_quaternion` gives it back.

    Raises:
        StreamError: the matrix is no rotation.
    """
    values, vectors = np.linalg.eigh(_symmetric(rotation))
    quaternion = np.asarray(vectors[:, int(np.argmax(values))])
    snapped = np.round(quaternion * 2.0**40) / 2.0**40
    quaternion = snapped / np.linalg.norm(snapped)
    if np.abs(rotation_from_quaternion(quaternion) - rotation).max() > 1e-6:
        raise StreamError("the camera's mounting: expected a rotation matrix")
    return quaternion if quaternion[3] >= 0.0 else -quaternion


def _symmetric(R: Array) -> Array:
    """Bar-Itzhack's matrix (4, 4), whose dominant eigenvector is the quaternion."""
    return np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
            [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )


_NEIGHBOURS = (0, *(sign * ulps for ulps in range(1, 9) for sign in (1, -1)))


def quaternion_of(yaw_rad: float) -> Array:
    """Quaternion (4,), x y z w, from which `yaw_from_quaternion` gives back `yaw_rad` itself.

    One heading in six comes back changed in its last bit from its own quaternion; that of a heading a few units in the last
    place away gives it exactly, if the heading was ever read from a quaternion.
    """
    for ulps in _NEIGHBOURS:
        quaternion = quaternion_from_yaw(yaw_rad + ulps * np.spacing(yaw_rad))
        if yaw_from_quaternion(*quaternion) == yaw_rad:
            return quaternion
    return quaternion_from_yaw(yaw_rad)
