"""Refined self-motion: each new node is registered to the submap of the last ones, with the odometry as prior."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hybridmap.config.laser import LaserConfig, SearchConfig
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose, wrap_angle
from hybridmap.graph.edges import Check, passed
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.cloud import Cloud, merged
from hybridmap.vision.laser.likelihood import LikelihoodField, build_field, score_starts, spaced, square
from hybridmap.vision.laser.registration import Alignment, Prior, align
from hybridmap.vision.laser.submap import Atlas

SCORED_POINTS = 90
WIDE_GAIN, LOST_GAIN = 0.03, 0.1


@dataclass(frozen=True, slots=True)
class Step:
    """The motion from one node to the next, as the scans have it.

    Attributes:
        relative: pose of the new node in the frame of the one before; the odometry's where nothing was measured.
        contradicts_odometry: a good registration says that the odometry is wrong.
        checks: that the registration was held against; the motion is the odometry's if one failed.
        inliers, fit: of the registration.
        scatter: covariance (3, 3) of the new node's place in the submap.
    """

    relative: RelativePose
    checks: tuple[Check, ...]
    contradicts_odometry: bool
    inliers: float
    fit: float
    scatter: Array

    @property
    def measured(self) -> bool:
        """Whether it comes from a registration."""
        return passed(self.checks)


class Tracker:
    """Registers each new node to the submap of the last ones."""

    def __init__(self, config: LaserConfig, atlas: Atlas) -> None:
        self._config = config
        self._atlas = atlas

    def step(self, cloud: Cloud, odometry: RelativePose, between_nodes: Callable[[], Iterable[tuple[Array, Cloud]]]) -> Step:
        """Say how the robot moved from the last node of the atlas to a new one.

        Args:
            cloud: scan of the new node.
            odometry: its pose in the frame of the last node.
            between_nodes: gives, in order, the scans between the two: motion since the last node and cloud.
        """
        c, field = self._config.tracking, self._field()
        best = self._search(field, cloud, odometry.delta)
        if self._doubtful(best, odometry.delta):
            stepped = self._step_by_step(field, cloud, odometry.delta, between_nodes())
            best = _better(best, stepped, 0.0)
        if self._doubtful(best, odometry.delta):
            best = _better(best, self._grid(field, cloud, odometry.delta, c.lost), LOST_GAIN)
        return self._judge(best, odometry)

    def pair(self, cloud: Cloud, following: Cloud, odometry: Array) -> Alignment:
        """The next scan registered to one scan alone, from where the odometry (3,) has it."""
        field = self._field_of(cloud)
        best = self._search(field, following, odometry)
        if self._doubtful(best, odometry):
            best = _better(best, self._grid(field, following, odometry, self._config.tracking.lost), LOST_GAIN)
        return best

    def _doubtful(self, alignment: Alignment, expected: Array) -> bool:
        """Whether a registration is weak, or contradicts the odometry without being very good."""
        c, inliers = self._config.tracking, alignment.inliers[0]
        return bool(inliers < c.inliers_min or (inliers < c.inliers_sure and self._contradicts(alignment.poses[0], expected)))

    def _field(self, extra: Sequence[Cloud] = ()) -> LikelihoodField:
        n = len(self._atlas)
        nodes = range(max(n - self._config.tracking.submap_nodes, self._atlas.piece(n - 1).start), n)
        cloud = self._atlas.submap(n - 1, nodes).cloud
        if extra:
            cloud = merged([cloud, *extra], self._config.scan.cell_m)
        return self._field_of(cloud)

    def _field_of(self, cloud: Cloud) -> LikelihoodField:
        settings = self._config.registration
        search = self._config.tracking.lost.half_m + 2 * self._config.scan.cell_m
        return build_field(cloud, self._config.scan.cell_m, settings.reach_m, settings.field_sigma_m, search)

    def _search(self, field: LikelihoodField, cloud: Cloud, expected: Array) -> Alignment:
        """Narrow first; wide when that is weak or disagrees with the odometry, and then whichever has more inliers."""
        c = self._config.tracking
        narrow = self._grid(field, cloud, expected, c.narrow)
        if narrow.inliers[0] >= c.inliers_min and not self._contradicts(narrow.poses[0], expected):
            return narrow
        return _better(narrow, self._grid(field, cloud, expected, c.wide), WIDE_GAIN)

    def _grid(self, field: LikelihoodField, cloud: Cloud, expected: Array, window: SearchConfig) -> Alignment:
        sigma_m, sigma_rad = window.prior_m, np.deg2rad(window.prior_deg)
        headings, offsets = np.deg2rad(spaced(window.half_deg, 2.0)), square(window.half_m, 0.1)
        scores = score_starts(field, cloud.thinned(SCORED_POINTS).points, expected[:2], expected[2] + headings, offsets)
        scores -= 0.05 * (headings[:, None] / sigma_rad) ** 2
        scores -= 0.05 * ((offsets / (2.0 * sigma_m)) ** 2).sum(axis=1)[None]
        h, t = np.unravel_index(int(np.argmax(scores)), scores.shape)
        start = np.array([*(expected[:2] + offsets[t]), expected[2] + headings[h]])
        prior = Prior(expected, sigma_m, float(sigma_rad))
        return align(field, cloud, start[None], self._config.registration, prior)

    def _step_by_step(
        self, field: LikelihoodField, cloud: Cloud, odometry: Array, between_nodes: Iterable[tuple[Array, Cloud]]
    ) -> Alignment:
        """Register the scans between the nodes one by one, each becoming part of the submap of the next."""
        pose, last = IDENTITY, IDENTITY
        seen: list[Cloud] = []
        for motion, scan in between_nodes:
            alignment = self._search(field, scan, compose(pose, between(last, motion)))
            pose, last = alignment.poses[0], motion
            if alignment.inliers[0] >= self._config.tracking.inliers_weak:
                seen.append(scan.moved(pose))
                field = self._field(seen)
        return self._search(field, cloud, compose(pose, between(last, odometry)))

    def _contradicts(self, pose: Array, expected: Array) -> bool:
        c = self._config.tracking
        off_m = float(np.hypot(*(pose - expected)[:2]))
        return off_m > c.contradiction_m or abs(wrap_angle(pose[2] - expected[2])) > np.deg2rad(c.contradiction_deg)

    def _judge(self, alignment: Alignment, odometry: RelativePose) -> Step:
        c = self._config.tracking
        pose, inliers, fit = alignment.poses[0], float(alignment.inliers[0]), float(alignment.fit[0])
        off_m = float(np.hypot(*(pose - odometry.delta)[:2]))
        asked = checks.of_step(inliers, off_m, c)
        if not passed(asked):
            return Step(odometry, asked, False, inliers, fit, odometry.covariance)
        covariance = alignment.covariance(0, self._config.registration, c.floor_m, np.deg2rad(c.floor_deg))
        if self._doubtful(alignment, odometry.delta):
            covariance = covariance + np.diag([0.05**2, 0.05**2, np.deg2rad(1.5) ** 2])
        wrong = bool(inliers >= c.inliers_min and self._contradicts(pose, odometry.delta))
        edge = self._atlas.joining(len(self._atlas) - 1, pose, covariance)
        return Step(edge, asked, wrong, inliers, fit, covariance)


def _better(first: Alignment, second: Alignment, gain: float) -> Alignment:
    """The second registration if it has more inliers by that much, else the first."""
    return second if second.inliers[0] > first.inliers[0] + gain else first
