"""Projective association of two depth grids: which points of either lie on the same surface, at one iterate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.config.rgbd import RegistrationConfig
from hybridmap.geometry import Array
from hybridmap.vision.rgbd.depth_grid import Surface

NEAREST_M = 0.1
"""A point must be at least this far in front of the camera that it is projected into."""


@dataclass(frozen=True, slots=True)
class Pairing:
    """Matched points, everything along the axes of the fixed base.

    Attributes:
        normal, turned: (n, 3) unit normals of the fixed and of the moving points.
        arm: (n, 3) moving points seen from the moving base, m.
        residual: (n,) point-to-plane distances, m.
        variance: (n,) that the sensor's model gives them, m^2.
        looked_at, in_view: how many moving points were projected, and how many fell on a known cell.
    """

    normal: Array
    turned: Array
    arm: Array
    residual: Array
    variance: Array
    looked_at: int
    in_view: int

    def __len__(self) -> int:
        return len(self.residual)


def associate(fixed: Surface, moving: Surface, T: Array, config: RegistrationConfig, stride: int = 1) -> Pairing:
    """Pair each moving point with the one in whose cell of the fixed grid it falls.

    Args:
        fixed, moving: surfaces in their own bases.
        T: (4, 4) the moving base in the fixed one.
        config: how far apart, and how differently inclined, the points of a pair may be.
        stride: look at every so many of the moving points only.
    """
    camera = fixed.grid.camera
    points = moving.points[::stride]
    seen = points @ (fixed.T_camera_base[:3, :3] @ T[:3, :3]).T + fixed.T_camera_base[:3] @ T[:, 3]
    z = np.maximum(seen[:, 2], 1e-6)
    column = camera.fx_px * seen[:, 0] / z + (camera.cx_px + 0.5)
    row = camera.fy_px * seen[:, 1] / z + (camera.cy_px + 0.5)
    inside = (seen[:, 2] > NEAREST_M) & (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    m = np.flatnonzero(inside)
    f = fixed.number[row[m].astype(np.int32), column[m].astype(np.int32)]
    m, f = m[f >= 0], f[f >= 0]
    normal = fixed.normals.take(f, axis=0)
    turned = moving.normals[::stride].take(m, axis=0) @ T[:3, :3].T
    arm = points.take(m, axis=0) @ T[:3, :3].T
    offset = arm + (T[:3, 3] - fixed.points.take(f, axis=0))
    residual = np.einsum("ij,ij->i", normal, offset)
    sigma_fixed, sigma_moving = fixed.sigma_m[f], moving.sigma_m[::stride][m]
    reach = config.max_distance_m + 3.0 * (sigma_fixed + sigma_moving)
    keep = np.abs(residual) < reach
    keep &= np.einsum("ij,ij->i", turned, normal) > np.cos(np.deg2rad(config.max_normal_deg))
    keep &= np.einsum("ij,ij->i", offset, offset) < 4.0 * reach * reach
    k = np.flatnonzero(keep)
    return Pairing(
        normal.take(k, axis=0),
        turned.take(k, axis=0),
        arm.take(k, axis=0),
        residual[k],
        sigma_fixed[k] ** 2 + sigma_moving[k] ** 2,
        len(points),
        len(m),
    )
