"""Headings as quaternions that read back to the same bits."""

from __future__ import annotations

import numpy as np

from hybridmap.geometry import Array, quaternion_from_yaw, yaw_from_quaternion

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
