"""Scan matching: a search for starts on a likelihood field, coarse to fine, then point-to-line registration from them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, compose, wrap_angle
from hybridmap.vision.laser.cloud import Cloud, LikelihoodField

OTHER_M, REACH_M = 0.4, 3.0
"""Smallest shift along a wall that is another position, and the largest one that is tried, m."""


def score_poses(field: LikelihoodField, points: Array, poses: Array) -> Array:
    """Mean likelihood (N,) in [0, 1] of points (P, 2) in a moving frame at each of its N poses (N, 3) in the field's frame."""
    cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    x = poses[:, :1] + cos * points[:, 0] - sin * points[:, 1]
    y = poses[:, 1:2] + sin * points[:, 0] + cos * points[:, 1]
    hits = field.likelihood.take(field.cells(x, y)).sum(axis=1, dtype=np.uint32)
    return np.asarray(hits / (255.0 * max(len(points), 1)))


def ambiguity(field: LikelihoodField, points: Array, direction: Array) -> float:
    """Likelihood of the second-best position along a direction, as a share of that of the registered pose.

    Args:
        field: likelihood field of the target.
        points: (P, 2) registered points, in the target's frame.
        direction: (2,) unit vector in the target's frame, along which the points are shifted both ways.
    """
    side = np.arange(OTHER_M, REACH_M, 0.1)
    shifts = np.concatenate([[0.0, -0.1, 0.1, -0.2, 0.2], -side, side])
    x = points[:, 0] + shifts[:, None] * direction[0]
    y = points[:, 1] + shifts[:, None] * direction[1]
    mean = field.likelihood.take(field.cells(x, y)).sum(axis=1, dtype=np.uint32)
    return float(mean[5:].max() / max(float(mean[:5].max()), 1.0))


def score_starts(field: LikelihoodField, points: Array, center: Array, headings_rad: Array, offsets_m: Array) -> Array:
    """Mean likelihood of points at every pose of a grid.

    Args:
        field: likelihood field of the target.
        points: (P, 2) in the moving frame, m.
        center: (2,) middle of the grid in the target's frame, m.
        headings_rad: (H,) headings of the moving frame in the target's.
        offsets_m: (T, 2) translations from the middle, rounded to cells; at most the `search_m` that the field was built for.

    Returns:
        (H, T) in [0, 1].
    """
    ny = field.shape[1]
    steps = np.round(offsets_m / field.cell_m).astype(np.int64)
    shift = steps[:, 0] * ny + steps[:, 1]
    cos, sin = np.cos(headings_rad)[:, None], np.sin(headings_rad)[:, None]
    x = center[0] + cos * points[:, 0] - sin * points[:, 1]
    y = center[1] + sin * points[:, 0] + cos * points[:, 1]
    base = field.cells(x, y)
    scores = np.empty((len(headings_rad), len(shift)))
    for h in range(len(headings_rad)):
        hits = field.likelihood.take(base[h][:, None] + shift[None])
        scores[h] = hits.sum(axis=0, dtype=np.uint32)
    return scores / (255.0 * max(len(points), 1))


STEP_M, STEP_DEG = 0.3, 2.0
"""Half a step of the wide grid of starts, m and degrees: the step of the search about the best ones."""
SURVIVORS = 24
"""Number of starts of the wide grid that are refined."""
SEPARATE_M, SEPARATE_DEG = 0.8, 12.0
"""Least difference of separate modes, m or degrees."""


@dataclass(frozen=True, slots=True)
class Start:
    """A pose (3,) of the moving frame in the target's, and the mean likelihood of its points there."""

    pose: Array
    score: float


def survivors(wide: LikelihoodField, points: Array, offsets_m: Array, headings_rad: Array) -> list[Start]:
    """The poses of a coarse grid with the largest likelihood, at most 24, the best first; they may be neighbours.

    Args:
        wide: the target's field with a likelihood as wide as the steps of the grid.
        points: (P, 2) in the moving frame.
        offsets_m: (T, 2) positions of the grid, twice `STEP_M` apart.
        headings_rad: (H,) headings of the grid, twice `STEP_DEG` apart.
    """
    scores = score_starts(wide, points, np.zeros(2), headings_rad, offsets_m)
    best = np.argsort(-scores, axis=None, kind="stable")[:SURVIVORS]
    h, t = np.unravel_index(best, scores.shape)
    poses = np.column_stack([offsets_m[t], headings_rad[h]])
    return [Start(pose, float(score)) for pose, score in zip(poses, scores[h, t], strict=True)]


def sharpened(sharp: LikelihoodField, points: Array, starts: list[Start], count: int) -> list[Start]:
    """Refine poses on a field of half the width; returns the best ones that lie apart from each other, the best first.

    Args:
        sharp: the target's field with half the width of that which found the starts.
        points: (P, 2) in the moving frame.
        starts: the poses to be refined, at least one.
        count: how many poses to return at most.
    """
    poses = (np.array([start.pose for start in starts])[:, None] + _star()[None]).reshape(-1, 3)
    return separated(poses, score_poses(sharp, points, poses), count)


def separated(poses: Array, scores: Array, count: int) -> list[Start]:
    """The best of poses (N, 3) with scores (N,), at most `count`, the best first.

    Poses close to a better one, and those with a score of 0, are left out.
    """
    left, out = scores.copy(), []
    for _ in range(count):
        i = int(np.argmax(left))
        if left[i] <= 0.0:
            break
        out.append(Start(poses[i], float(left[i])))
        near_m = np.hypot(*(poses[:, :2] - poses[i, :2]).T) < SEPARATE_M
        near_rad = np.abs(wrap_angle(poses[:, 2] - poses[i, 2])) < np.deg2rad(SEPARATE_DEG)
        left[near_m & near_rad] = 0.0
    return out


def spaced(half: float, step: float) -> Array:
    """Evenly spaced numbers from -half to half, at most `step` apart, 0 among them."""
    count = int(np.ceil(half / step))
    return np.linspace(-half, half, 2 * count + 1)


def square(half_m: float, step_m: float) -> Array:
    """(T, 2) translations on a square grid: x and y from -half_m to half_m, at most `step_m` apart."""
    side = spaced(half_m, step_m)
    return np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)


def _star() -> Array:
    """(15, 3) a step aside in x or y or none, at each of three headings."""
    moves = np.array([[0.0, 0.0], [STEP_M, 0.0], [-STEP_M, 0.0], [0.0, STEP_M], [0.0, -STEP_M]])
    turns: NDArray[np.float64] = np.deg2rad(np.array([-STEP_DEG, 0.0, STEP_DEG]))
    return np.column_stack([np.tile(moves, (3, 1)), np.repeat(turns, len(moves))])


CAUCHY_CELLS = 1.0
"""Residual at which a partner's weight is halved, cells of the field: 5 cm indoors."""
ITERATIONS = 20
"""Most iterations; a good start needs less than half of them."""
INLIER_CELLS = 2.0
"""Largest point-to-line residual of an inlier, cells of the field: 10 cm indoors."""
SIGMA_M = 0.01
"""Standard deviation of a point's residual at least, m: the noise of a laser."""
SPURIOUS = 0.04
"""Share of the inliers whose information along any direction is subtracted: normals err by some 10 degrees."""
WIDE, WIDE_ITERATIONS = 2.0, 2
"""Factor on that scale in the first iterations, and how many these are."""
LARGEST_STEP = 0.3
"""No iteration moves the cloud by more, m and rad."""
FACING = -0.1
"""Least cosine between the normals of partners: the two sides of a wall are not partners."""
CONVERGED = 5e-4
"""Iterations end when none moves the cloud by more, m and rad."""
LEAST = 1e-6
"""Information added to that of the points, so that there is a solution without them."""
WEAKEST_INFORMATION = (1.0, 1.0, 4.0)
"""Least information of a registration: standard deviations of a metre and half a radian."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Expected pose of the moving frame in the target's, (3,) or (K, 3) for K starts, and its standard deviations (m, rad)."""

    pose: Array
    sigma_m: float
    sigma_rad: float


@dataclass(frozen=True, slots=True)
class Alignment:
    """K registrations of a cloud, from K starts.

    Attributes:
        poses: (K, 3) of the moving frame in the target's.
        hessian: (K, 3, 3) of the points alone (no prior), per squared metre of residual, right perturbation.
        near: (K,) share of points that have a partner.
        inliers: (K,) share of all points whose residual is small (below two cells of the field).
        fit: (K,) share of inliers among the points that have a partner.
        rms_m: (K,) root mean square of the inliers' residuals, m.
        points: number of points that were registered.
    """

    poses: Array
    hessian: Array
    near: Array
    inliers: Array
    fit: Array
    rms_m: Array
    points: int

    def covariance(self, k: int, floor_m: float, floor_rad: float) -> Array:
        """Covariance (3, 3) of registration k in the moving frame: variance of the residuals times the inverse Hessian.

        The squares of `floor_m` and `floor_rad` are added, for errors that residuals do not show (a bent target).
        """
        variance = max(SIGMA_M, float(self.rms_m[k])) ** 2
        trusted = self._without_spurious(k, SPURIOUS)
        covariance = np.linalg.inv(trusted / variance + np.diag(WEAKEST_INFORMATION))
        floor = np.diag([floor_m**2, floor_m**2, floor_rad**2])
        return np.asarray(0.5 * (covariance + covariance.T) + floor)

    def weakest_direction(self, k: int) -> Array:
        """Unit vector (2,) in the moving frame along which registration k is least certain."""
        return np.asarray(np.linalg.eigh(self._translation(k))[1][:, 0])

    def _translation(self, k: int) -> Array:
        """Hessian of the translation alone (2, 2), the heading eliminated."""
        h = self.hessian[k]
        return np.asarray(h[:2, :2] - np.outer(h[:2, 2], h[2, :2]) / max(float(h[2, 2]), 1e-9))

    def _without_spurious(self, k: int, share: float) -> Array:
        """The Hessian less that of a `share` of the points: with noisy normals a bare wall seems to hold along itself."""
        out = self.hessian[k].copy()
        value, vector = np.linalg.eigh(self._translation(k))
        lost = np.minimum(value, share * self.points * float(self.inliers[k]))
        out[:2, :2] -= (vector * lost) @ vector.T
        return np.asarray(out)


def ambiguity_of(field: LikelihoodField, cloud: Cloud, alignment: Alignment) -> float:
    """Ambiguity of the first registration of a cloud (moving frame) along its least certain direction; see `ambiguity`."""
    pose, weakest = alignment.poses[0], alignment.weakest_direction(0)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    direction = np.array([cos * weakest[0] - sin * weakest[1], sin * weakest[0] + cos * weakest[1]])
    return ambiguity(field, cloud.moved(pose).points, direction)


@dataclass(frozen=True, slots=True)
class _Moving:
    """Points and normals of a cloud, a contiguous array (P,) or (K, P) each."""

    x: Array
    y: Array
    normal_x: Array
    normal_y: Array


@dataclass(frozen=True, slots=True)
class _Partners:
    """Residuals (K, P) m, body-frame Jacobians (K, 3, P) and whether each point has a partner (K, P)."""

    residual: Array
    jacobian: Array
    has: NDArray[np.bool_]


def align(field: LikelihoodField, cloud: Cloud, starts: Array, prior: Prior | None = None) -> Alignment:
    """Register a cloud from K starts: Gauss-Newton on point-to-line residuals with Cauchy weights.

    Args:
        field: likelihood field of the target.
        cloud: P points in the moving frame.
        starts: (K, 3) poses of the moving frame in the target's.
        prior: expected pose, which joins the solve; the result's `hessian` leaves it out.

    Returns:
        One result for each start, in their order; those that fit nowhere have few inliers.
    """
    poses = np.array(starts, dtype=np.float64)
    moving = _Moving(*(np.ascontiguousarray(a[..., i]) for a in (cloud.points, cloud.normals) for i in (0, 1)))
    narrow = CAUCHY_CELLS * field.cell_m
    scale = WIDE * narrow
    for iteration in range(ITERATIONS):
        hessian, gradient = _normal_equations(_partners(field, moving, poses), scale)
        steps = _newton_steps(hessian, gradient, poses, prior)
        poses = compose(poses, steps.clip(-LARGEST_STEP, LARGEST_STEP))
        if iteration >= WIDE_ITERATIONS:
            scale = narrow
            if np.abs(steps).max() < CONVERGED:
                break
    return _judge(_partners(field, moving, poses), poses, INLIER_CELLS * field.cell_m)


def _partners(field: LikelihoodField, moving: _Moving, poses: Array) -> _Partners:
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x = cos * moving.x - sin * moving.y + poses[:, :1]
    y = sin * moving.x + cos * moving.y + poses[:, 1:2]
    label = field.labels.take(field.cells(x, y))
    nx, ny, offset = (column.take(label) for column in field.lines)
    jacobian = np.empty((len(poses), 3, x.shape[1]))
    bx, by = jacobian[:, 0], jacobian[:, 1]
    np.add(cos * nx, sin * ny, out=bx)
    np.subtract(cos * ny, sin * nx, out=by)
    np.subtract(by * moving.x, bx * moving.y, out=jacobian[:, 2])
    has = (label > 0) & (bx * moving.normal_x + by * moving.normal_y > FACING)
    return _Partners(nx * x + ny * y - offset, jacobian, has)


def _normal_equations(partners: _Partners, scale: float) -> tuple[Array, Array]:
    w = partners.has / (1.0 + (partners.residual * (1.0 / scale)) ** 2)
    weighted = partners.jacobian * w[:, None]
    hessian = weighted @ partners.jacobian.transpose(0, 2, 1)
    gradient = (weighted @ partners.residual[..., None])[..., 0]
    return hessian / scale**2, gradient / scale**2


def _newton_steps(hessian: Array, gradient: Array, poses: Array, prior: Prior | None) -> Array:
    """Steps (K, 3) in the body frame, with the prior; three unknowns are solved fastest without arrays."""
    expected = poses.tolist() if prior is None else np.broadcast_to(prior.pose, poses.shape).tolist()
    weight_m, weight_rad = (0.0, 0.0) if prior is None else (prior.sigma_m**-2, prior.sigma_rad**-2)
    steps = []
    for pose, middle, h, g in zip(poses.tolist(), expected, hessian.tolist(), gradient.tolist(), strict=True):
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        x, y = pose[0] - middle[0], pose[1] - middle[1]
        turn = math.remainder(pose[2] - middle[2], 2.0 * math.pi)
        g = [g[0] + weight_m * (cos * x + sin * y), g[1] + weight_m * (cos * y - sin * x), g[2] + weight_rad * turn]
        for i, weight in enumerate((weight_m, weight_m, weight_rad)):
            h[i][i] += weight + LEAST
        steps.append(_solved(h, g))
    return np.array(steps)


def _solved(h: list[list[float]], g: list[float]) -> list[float]:
    """Solution of h step = -g for a symmetric positive definite h, by its LDL decomposition."""
    l1, l2 = h[0][1] / h[0][0], h[0][2] / h[0][0]
    d1, middle = h[1][1] - l1 * h[0][1], h[1][2] - l1 * h[0][2]
    l3 = middle / d1
    d2 = h[2][2] - l2 * h[0][2] - l3 * middle
    y1 = -g[1] + l1 * g[0]
    z2 = (-g[2] + l2 * g[0] - l3 * y1) / d2
    z1 = y1 / d1 - l3 * z2
    return [-g[0] / h[0][0] - l1 * z1 - l2 * z2, z1, z2]


def _judge(partners: _Partners, poses: Array, inlier_m: float) -> Alignment:
    inlier = partners.has & (np.abs(partners.residual) < inlier_m)
    count, near = inlier.sum(axis=1), partners.has.sum(axis=1)
    n = max(partners.has.shape[1], 1)
    jacobian = partners.jacobian * inlier[:, None]
    return Alignment(
        poses=poses,
        hessian=jacobian @ jacobian.transpose(0, 2, 1),
        near=near / n,
        inliers=count / n,
        fit=count / np.maximum(near, 1),
        rms_m=np.sqrt((partners.residual**2 * inlier).sum(axis=1) / np.maximum(count, 1)),
        points=n,
    )
