"""Small worlds of line segments, simulated laser scans of them, and drives through them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import IDENTITY, RelativePose, between, compose
from hybridmap.graph.edges import EdgeKind
from hybridmap.streams.laser import Laser, LaserScan
from hybridmap.vision.base import Belief
from hybridmap.vision.laser.front_end import LaserFrontEnd
from tests.narrowing import known

LASER = Laser(np.deg2rad(np.arange(-135.0, 136.0, 1.0)), 0.05, 30.0, np.array([0.1, 0.0, 0.0]))
SIGMAS = np.array([0.03, 0.03, np.deg2rad(0.5)])


def box(x0, y0, x1, y1):
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


def room():
    """A room of 8 x 6 m with furniture and without symmetry."""
    return np.array(
        [
            *box(-4, -3, 4, 3),
            *box(2.2, 1.5, 3.2, 2.4),
            *box(-3.5, -2.6, -2.3, -2.0),
            *box(-1.0, 2.4, 0.7, 3.0),
            (4, -1, 3.1, -1),
        ]
    )


def corridor(length=80.0):
    """Two bare walls 2.4 m apart. The ends are out of sight from the middle."""
    return np.array([(-length / 2, -1.2, length / 2, -1.2), (-length / 2, 1.2, length / 2, 1.2)])


def ring():
    """A corridor 2 m wide around a block of 12 x 8 m. No two places look alike."""
    rng = np.random.default_rng(5)
    walls = [*box(-8, -6, 8, 6), *box(-6, -4, 6, 4)]
    for x in (-7.0, -4.6, -1.3, 1.9, 5.2):
        w, d = rng.uniform(0.4, 1.2), rng.uniform(0.2, 0.5)
        walls += box(x, 6 - d, x + w, 6)
    for x in (-5.5, -2.2, 0.4, 4.1):
        w, d = rng.uniform(0.3, 1.4), rng.uniform(0.2, 0.5)
        walls += box(x, -6, x + w, -6 + d)
    for y in (-3.0, 0.2, 2.7):
        w, d = rng.uniform(0.3, 1.2), rng.uniform(0.2, 0.5)
        walls += [*box(8 - d, y, 8, y + w), *box(-8, y - 1.3, -8 + d, y - 1.3 + w)]
    return np.array(walls)


def cast(world, pose, rng=None, laser=LASER, sigma_m=0.01):
    """Return the ranges (B,) float32 from a pose of `base_link`. A beam that meets no wall gives NaN."""
    x, y, yaw = compose(pose, laser.pose_base_laser)
    angle = yaw + laser.bearings_rad
    dx, dy = np.cos(angle)[:, None], np.sin(angle)[:, None]
    ax, ay, bx, by = world.T
    ex, ey = bx - ax, by - ay
    det = dx * ey - dy * ex
    safe = np.where(np.abs(det) < 1e-12, 1e-12, det)
    t = ((ax - x) * ey - (ay - y) * ex) / safe
    u = ((ax - x) * dy - (ay - y) * dx) / safe
    hit = (np.abs(det) > 1e-12) & (t > 0) & (u >= 0) & (u <= 1)
    ranges = np.where(hit, t, np.inf).min(axis=1)
    if rng is not None:
        ranges = ranges + rng.normal(0.0, sigma_m, ranges.shape)
    ranges[~(ranges < laser.range_max_m)] = np.nan
    return ranges.astype(np.float32)


def ring_drive(laps, step_m=0.1):
    """Return poses (N, 3) of a counter-clockwise drive around the ring. The robot turns on the spot at the corners."""
    corners = [(-7.0, -5.0), (7.0, -5.0), (7.0, 5.0), (-7.0, 5.0)]
    poses = []
    for leg in range(round(4 * laps)):
        a, b = np.array(corners[leg % 4]), np.array(corners[(leg + 1) % 4])
        yaw, length = np.arctan2(*(b - a)[::-1]), np.hypot(*(b - a))
        poses += [(*(a + (b - a) * s), yaw) for s in np.arange(0.0, 1.0, step_m / length)]
        poses += [(*b, yaw + turn) for turn in np.arange(0.0, np.pi / 2, np.deg2rad(6.0))]
    return np.array(poses)


def drifting(poses, rng, bias_deg_per_m=1.0, noise_deg=0.05, gain=1.01):
    """Return odometry of a drive, from the first pose on, with a gain, a heading bias per metre and white noise."""
    out = [poses[0]]
    for a, b in pairwise(poses):
        step = between(a, b)
        step[:2] *= gain
        step[2] += np.deg2rad(bias_deg_per_m) * np.hypot(step[0], step[1]) + rng.normal(0.0, np.deg2rad(noise_deg))
        out.append(compose(out[-1], step))
    return np.array(out)


class Run:
    """Run the laser front-end on a drive through a world. No solver runs: the belief has the poses of the chain."""

    def __init__(self, world, truth, odometry, every=5, config=None, seed=0):
        rng = np.random.default_rng(seed)
        self.front_end = LaserFrontEnd(config or VisionConfig(), LASER)
        self.proposals, self.poses, self.travel, last = [], [IDENTITY], [0.0], 0
        self.truth = truth
        self.node_at: list[int] = []
        for i, pose in enumerate(truth):
            motion = between(odometry[last], odometry[i])
            scan = LaserScan(1_000_000_000 + i * 100_000_000, cast(world, pose, rng))
            view = self.front_end.observe(scan, motion)
            if i % every:
                continue
            node = len(self.node_at)
            self.node_at.append(i)
            self.front_end.add_node(node, view)
            relative = RelativePose(motion, np.diag(SIGMAS**2)) if node else None
            tracked = self.front_end.track(node, relative)
            if node:
                step = known(tracked[0].relative if tracked and tracked[0].relative else relative)
                self.poses.append(compose(self.poses[-1], step.delta))
                self.travel.append(self.travel[-1] + np.hypot(*step.delta[:2]))
            self.proposals += tracked + self.front_end.close(node, self.belief())
            last = i

    def belief(self, poses=None):
        travel = np.array(self.travel)

        def covariance_from(node):
            way = np.abs(travel - travel[node])
            sigma_rad = np.deg2rad(0.11) * np.sqrt(way)
            sigma_m = 0.005 * np.sqrt(way) + sigma_rad * way / 2
            return np.stack([np.diag([s**2, s**2, r**2]) for s, r in zip(sigma_m, sigma_rad, strict=True)])

        return Belief(np.array(self.poses) if poses is None else poses, np.zeros(len(travel)), travel, covariance_from)

    def loops(self, verdict):
        final = {p.key: p for p in self.proposals if p.kind is EdgeKind.LOOP}
        return [p for p in final.values() if p.status is verdict]

    def error(self, proposal):
        a, b = self.truth[self.node_at[proposal.source]], self.truth[self.node_at[proposal.target]]
        return between(between(a, b), proposal.relative.delta)
