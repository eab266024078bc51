"""Projective association of two depth grids: which points of either lie on the same surface, at one iterate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.config.rgbd import RegistrationConfig
from hybridmap.geometry import Array
from hybridmap.vision.rgbd.depth_grid import Surface
from hybridmap.vision.rgbd.spatial import wrenches

NEAREST_M = 0.1
"""A point must be at least this far in front of the camera that it is projected into."""


@dataclass(frozen=True, slots=True)
class Pairing:
    """Points of a moving surface beside those in whose cells of a fixed one they fall, along the axes of the fixed base.

    Attributes:
        normal, turned: (3, n) unit normals of the fixed and of the moving points.
        arm: (3, n) moving points seen from the moving base, m.
        residual: (n,) point-to-plane distances, m.
        variance: (n,) that the sensor's model gives them, m^2; infinite where the two do not match.
        matched: how many do.
        looked_at: how many moving points were projected; n of them fell on a known cell.
    """

    normal: Array
    turned: Array
    arm: Array
    residual: Array
    variance: Array
    matched: int
    looked_at: int

    @property
    def in_view(self) -> int:
        """How many moving points fell on a known cell: n."""
        return len(self.residual)

    def mean(self, values: Array) -> float:
        """Mean over the points that match, of values (n,)."""
        return float(values[np.isfinite(self.variance)].sum()) / max(self.matched, 1)

    def terms(self) -> tuple[Array, Array]:
        """H (6, 6) and b (6,) of the normal equations, with Cauchy weights."""
        J = wrenches(self.arm, self.normal)
        weighted = J / (self.variance + 0.25 * self.residual**2)
        return weighted @ J.T, -weighted @ self.residual


def associate(fixed: Surface, moving: Array, T: Array, config: RegistrationConfig) -> Pairing:
    """Pair each moving point with the one in whose cell of the fixed grid it falls.

    Args:
        fixed: the surface in its own base.
        moving: (7, N) rows of the other surface, or some of their columns.
        T: (4, 4) the moving base in the fixed one.
        config: how far apart, and how differently inclined, the points of a pair may be.
    """
    camera, turn = fixed.grid.camera, T[:3, :3]
    matrix = np.array([[camera.fx_px, 0.0, camera.cx_px + 0.5], [0.0, camera.fy_px, camera.cy_px + 0.5], [0.0, 0.0, 1.0]])
    projection = matrix @ fixed.T_camera_base[:3] @ T
    seen = projection[:, :3] @ moving[:3] + projection[:, 3:]
    z = np.maximum(seen[2], 1e-6)
    column, row = seen[0] / z, seen[1] / z
    inside = (seen[2] > NEAREST_M) & (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    m = np.flatnonzero(inside)
    f = fixed.number.ravel()[row[m].astype(np.int32) * camera.width_px + column[m].astype(np.int32)]
    known = f >= 0
    theirs, ours = fixed.rows.take(f[known], axis=1), moving.take(m[known], axis=1)
    normal, arm, turned = theirs[3:6], turn @ ours[:3], turn @ ours[3:6]
    offset = arm + (T[:3, 3:] - theirs[:3])
    residual = np.einsum("ij,ij->j", normal, offset)
    reach = config.max_distance_m + 3.0 * (theirs[6] + ours[6])
    keep = np.abs(residual) < reach
    keep &= np.einsum("ij,ij->j", turned, normal) > np.cos(np.deg2rad(config.max_normal_deg))
    keep &= np.einsum("ij,ij->j", offset, offset) < 4.0 * reach * reach
    variance = np.where(keep, theirs[6] ** 2 + ours[6] ** 2, np.inf)
    return Pairing(normal, turned, arm, residual, variance, int(np.count_nonzero(keep)), moving.shape[1])
