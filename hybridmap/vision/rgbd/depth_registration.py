"""Point-to-plane registration of two depth grids, optionally with pairs of keypoints, in all six degrees of freedom.

The robot stays on the floor: height and tilt have a tight prior, and only x, y and yaw leave this module. A perturbation is
a shift of the moving robot's origin and a turn about it, both along the axes of the fixed robot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import Array, RelativePose, loosest_direction
from hybridmap.vision.rgbd.depth_grid import Surface
from hybridmap.vision.rgbd.pairs import PointPairs
from hybridmap.vision.rgbd.stance import LevelPair, Stance, from_planar, level_pair, rotation_of, to_floor, wrenches

ITERATIONS = 10
"""Most Gauss-Newton steps; a good start needs half of them."""
MAX_DISTANCE_M, MAX_NORMAL_DEG = 0.15, 30.0
"""Points of two surfaces are a pair no farther apart than this (plus the noise of depth), m, and no more inclined, degrees."""
MIN_POINTS = 60
"""Fewest pairs: 3 % of a picture's cells."""
NOISE_SIGMAS = 3.0
"""Standard deviations of depth that are allowed beside that distance."""
ASIDE = 4.0
"""A pair lies at most this many times that distance apart in all directions (squares): twice, along the surface too."""
TAILS = 0.25
"""Share of a squared residual that is added to the variance of its point: a Cauchy weight of two standard deviations."""
CORRELATION = 30.0
"""So many neighbouring points count as one where sliding is tested: errors of depth are correlated over some cells."""
PLANAR = np.array([0, 1, 5])
OUT_OF_PLANE = np.array([2, 3, 4])
COARSE_POINTS = 400
NEARLY_SETTLED, SETTLED = 1e-2, 5e-4
"""While steps (m, rad) exceed the first, about so many points do; it ends with all of them and a step below the second."""
LEAST_UNIT_VARIANCE = 0.1
"""Least variance of residuals, as a share of that of the sensor's model."""
LOOSE = 1.0 / np.array([0.3, 0.3, np.deg2rad(10.0)]) ** 2
"""Information (m^-2, m^-2, rad^-2) that every edge keeps, so that a corridor's long axis stays loose and not infinite."""


@dataclass(frozen=True, slots=True)
class _Prior:
    """The prior of a registration, along the axes of the fixed robot.

    Attributes:
        delta: (3,) pose by the wheels (anything where there are none).
        floor: (3,) information of dz (m^-2) and of roll and pitch (rad^-2): both robots stand on the same floor.
        information: (6, 6) of floor and wheels together.
    """

    delta: Array
    floor: Array
    information: Array

    @classmethod
    def of(cls, fixed: Stance, moving: Stance, odometry: RelativePose | None) -> _Prior:
        height = fixed.height_sigma_m**2 + moving.height_sigma_m**2
        tilt = fixed.tilt_sigma_rad**2 + moving.tilt_sigma_rad**2
        floor, information = 1.0 / np.array([height, tilt, tilt]), np.zeros((6, 6))
        information[OUT_OF_PLANE, OUT_OF_PLANE] = floor
        if odometry is None:
            return cls(np.zeros(3), floor, information)
        axes = from_planar(odometry.delta)[:3, :3]
        information[PLANAR[:, None], PLANAR] = axes @ np.linalg.inv(odometry.covariance) @ axes.T
        return cls(odometry.delta, floor, information)

    def pull(self, T: Array) -> Array:
        """Side b (6,) of the normal equations at a pose (4, 4); their H is the information."""
        flat = to_floor(T)
        x, y, yaw = (flat.delta - self.delta).tolist()
        turned = (yaw + np.pi) % (2.0 * np.pi) - np.pi
        return np.asarray(-self.information @ np.array([x, y, flat.height_m, -T[1, 2], T[0, 2], turned]))


@dataclass(frozen=True, slots=True)
class Registration:
    """Result of a depth registration.

    Attributes:
        T_fixed_moving: (4, 4) moving base in the fixed one, the bases as the cameras' stances had them.
        level: the same after both bases are levelled.
        relative: planar part of `level`, with the covariance that the residuals alone give (the prior is taken out), points
            erring independently; see `noise_level` for what it really is.
        slack_m: standard deviation in the loosest direction if every `CORRELATION` points counted as one, m: it says whether
            the surfaces hold each other, whatever the noise.
        points: number of matched points.
        inliers: share of the points in common view that fit, 0..1.
        residual_m: root mean square point-to-plane distance of the inliers, m.
        overlap: share of the moving points that are in the fixed frame's view, 0..1.
        height_m, tilt_rad: height and tilt of the pose, which its planar part leaves out.
    """

    T_fixed_moving: Array
    level: LevelPair
    relative: RelativePose
    slack_m: float
    points: int
    inliers: float
    residual_m: float
    overlap: float
    height_m: float
    tilt_rad: float


def register(
    fixed: Surface,
    moving: Surface,
    start: Array,
    prior: RelativePose | None,
    pairs: PointPairs | None = None,
) -> Registration | None:
    """Register the depth of the moving robot to that of the fixed one.

    Args:
        fixed, moving: surfaces in their own bases.
        start: (4, 4) first guess of the moving base in the fixed one; it is not changed.
        prior: moving base in the fixed one by odometry or map, which joins the solve; taken out of the result's covariance.
        pairs: matched keypoints that join the solve.

    Returns:
        The registration, which may still fit badly (see its figures); None if too few points match.
    """
    T, stride = start.copy(), max(1, moving.rows.shape[1] // COARSE_POINTS)
    known = _Prior.of(fixed.stance, moving.stance, prior)
    rows = np.ascontiguousarray(moving.rows[:, ::stride])
    settled: Pairing | None = None
    for _ in range(ITERATIONS):
        pairing = associate(fixed, rows, T)
        if pairing.matched * stride < MIN_POINTS:
            return None
        step = _step(pairing, T, known, pairs)
        T[:3, 3] += step[:3]
        T[:3, :3] = rotation_of(step[3:]) @ T[:3, :3]
        largest = float(np.abs(step).max())
        if stride == 1 and largest < SETTLED:
            settled = pairing
            break
        if largest < NEARLY_SETTLED:
            rows, stride = moving.rows, 1
    at_end = associate(fixed, moving.rows, T) if settled is None else settled
    return _summarise(fixed.stance, moving.stance, T, at_end, known.floor, pairs)


def _step(pairing: Pairing, T: Array, known: _Prior, pairs: PointPairs | None) -> Array:
    """Gauss-Newton: a shift and a turn (6,)."""
    H, b = pairing.terms()
    if pairs is not None:
        H_pairs, b_pairs = pairs.terms(T)
        H, b = H + H_pairs, b + b_pairs
    return np.asarray(np.linalg.solve(H + known.information, b + known.pull(T)))


def _summarise(
    fixed: Stance,
    moving: Stance,
    T: Array,
    pairing: Pairing,
    floor: Array,
    pairs: PointPairs | None,
) -> Registration | None:
    if pairing.matched < MIN_POINTS:
        return None
    H_depth = _information(pairing)
    H_pairs = np.zeros((6, 6)) if pairs is None else pairs.terms(T)[0]
    flat, level = to_floor(T), level_pair(T, fixed, moving)
    arm = moving.T_base_camera[2, 3] * T[:3, 2]
    both = np.stack([H_depth + H_pairs, H_depth / CORRELATION + H_pairs])
    covariance, dulled = _planar_covariances(both, arm, level.delta[2], floor)
    return Registration(
        T,
        level,
        RelativePose(level.delta, covariance),
        loosest_direction(dulled)[0],
        pairing.matched,
        pairing.matched / max(pairing.in_view, 1),
        float(np.sqrt(pairing.mean(pairing.residual**2))),
        pairing.in_view / max(pairing.looked_at, 1),
        flat.height_m,
        flat.tilt_rad,
    )


def _information(pairing: Pairing) -> Array:
    """Information (6, 6) of the matched points, each with the variance that the residuals show.

    Squared noise of normals looks like information: a bare wall would seem to hold the slide along itself. The product of the
    two points' own normals has no such bias, as their errors are independent. Negative results count as 0.
    """
    unit = max(pairing.mean(pairing.residual**2 / pairing.variance), LEAST_UNIT_VARIANCE)
    J_fixed, J_moving = wrenches(pairing.arm, pairing.normal), wrenches(pairing.arm, pairing.turned)
    weighted = J_fixed / (unit * pairing.variance)
    both, biased = weighted @ J_moving.T, weighted @ J_fixed.T
    root = np.linalg.cholesky(biased + 1e-9 * np.trace(biased) * np.eye(6))
    share = np.linalg.solve(root, np.linalg.solve(root, 0.5 * (both + both.T)).T)
    values, vectors = np.linalg.eigh(0.5 * (share + share.T))
    base = root @ vectors
    return np.asarray((base * np.maximum(values, 1e-4)) @ base.T)


def _planar_covariances(H: Array, arm: Array, yaw: float, floor: Array) -> Array:
    """Covariances (k, 3, 3) of x, y, yaw in the moving frame, of informations (k, 6, 6): height and tilt are marginalised
    under the information of their prior (3,).

    The point whose position counts is the one at the camera's height (`arm` above the origin): bases are levelled
    afterwards, and a tilt turns about the camera.
    """
    about = np.eye(6)
    about[:3, 3:] = [[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]]
    full = about.T @ H @ about
    full[:, OUT_OF_PLANE, OUT_OF_PLANE] += floor
    full[:, PLANAR, PLANAR] += LOOSE
    covariance = np.linalg.inv(full)[:, PLANAR[:, None], PLANAR]
    cos, sin = np.cos(yaw), np.sin(yaw)
    axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    turned = axes @ covariance @ axes.T
    return np.asarray(0.5 * (turned + turned.transpose(0, 2, 1)))


NEAREST_M = 0.1
"""A point must be at least this far in front of the camera that it is projected into."""


@dataclass(frozen=True, slots=True)
class Pairing:
    """Points of a moving surface, each paired with the point of a fixed surface in whose grid cell it falls.

    All vectors are along the axes of the fixed base.

    Attributes:
        normal, turned: (3, n) unit normals of the fixed and of the moving points.
        arm: (3, n) moving points seen from the moving base, m.
        residual: (n,) point-to-plane distances, m.
        variance: (n,) of the residuals by the sensor's model, m^2; infinite where the two points do not match.
        matched: number of pairs that match.
        looked_at: number of moving points that were projected; n of them fell on a cell with a point.
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
        """Number of moving points that fell on a cell with a point (n)."""
        return len(self.residual)

    def mean(self, values: Array) -> float:
        """Mean of values (n,), one a pair, over the pairs that match."""
        return float(values[np.isfinite(self.variance)].sum()) / max(self.matched, 1)

    def terms(self) -> tuple[Array, Array]:
        """H (6, 6) and b (6,) of the normal equations H xi = b, with Cauchy weights.

        xi is a shift (3) of the moving base and a small turn (3) about it, along the axes of the fixed base.
        """
        J = wrenches(self.arm, self.normal)
        weighted = J / (self.variance + TAILS * self.residual**2)
        return weighted @ J.T, -weighted @ self.residual


def associate(fixed: Surface, moving: Array, T: Array) -> Pairing:
    """Pair each moving point with the fixed point in whose grid cell it falls; the pairs need not match.

    Args:
        fixed: the surface in its own base.
        moving: (7, N) `Surface.rows` of the other surface, or some of their columns.
        T: (4, 4) the moving base in the fixed one.
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
    reach = MAX_DISTANCE_M + NOISE_SIGMAS * (theirs[6] + ours[6])
    keep = np.abs(residual) < reach
    keep &= np.einsum("ij,ij->j", turned, normal) > np.cos(np.deg2rad(MAX_NORMAL_DEG))
    keep &= np.einsum("ij,ij->j", offset, offset) < ASIDE * reach * reach
    variance = np.where(keep, theirs[6] ** 2 + ours[6] ** 2, np.inf)
    return Pairing(normal, turned, arm, residual, variance, int(np.count_nonzero(keep)), moving.shape[1])
