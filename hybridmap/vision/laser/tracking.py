"""Registration of each new node to the submap of the last ones, with the odometry as prior."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose, wrap_angle
from hybridmap.graph.edges import Check, passed
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.cloud import Cloud, LikelihoodField, build_field, merged
from hybridmap.vision.laser.scan_matching import Alignment, Prior, align, score_starts, spaced, square
from hybridmap.vision.laser.submap import Atlas

SUBMAP_NODES = 25
"""Nodes in the submap: some 12 m of travel, in which the chain hardly bends."""


@dataclass(frozen=True, slots=True)
class SearchWindow:
    """A grid of start poses around the odometry, and the standard deviations of the odometry as prior.

    Attributes:
        half_m, half_deg: half-widths of the grid, in x and y and in heading.
        prior_m, prior_deg: standard deviations of the odometry.
    """

    half_m: float
    half_deg: float
    prior_m: float
    prior_deg: float


NARROW = SearchWindow(half_m=0.2, half_deg=8.0, prior_m=0.1, prior_deg=5.0)
"""First search: usual wheels over half a metre."""
WIDE = SearchWindow(half_m=0.45, half_deg=40.0, prior_m=0.1, prior_deg=40.0)
"""Second search, when the first is weak or contradicts the odometry: drop-outs of wheels are mostly of heading."""
LOST = SearchWindow(half_m=1.0, half_deg=60.0, prior_m=0.7, prior_deg=60.0)
"""Last search, when the scans between the nodes did not help either."""
RESUMED = SearchWindow(half_m=0.45, half_deg=8.0, prior_m=0.1, prior_deg=5.0)
"""Search after a break of the chain: wheels over some metres that did not slip."""
INLIERS_SURE = 0.75
"""Least share of inliers at which a registration may contradict the odometry without further search."""
CONTRADICTION_M, CONTRADICTION_DEG = 0.15, 3.0
"""A good registration this far from the odometry drops the odometry edge, m and degrees: several times its usual error."""
FLOOR_M, FLOOR_DEG = 0.001, 0.02
"""Least standard deviations of a node's pose in the submap, m and degrees: errors that residuals do not show."""
GRID_M, GRID_DEG = 0.1, 2.0
"""Steps of the grid of starts, m and degrees."""
PULL = 0.05
"""Loss of a start's score at one standard deviation of the odometry's heading, or at two of its translation."""
WEAK_M, WEAK_DEG = 0.05, 1.5
"""Standard deviations that are added to a registration which is not good, m and degrees."""
ABOUT_M = 1.0
"""Travel to either side of a node whose scans show a place, m: what one scan does not see, its neighbours do."""
SCORED_POINTS = 90
"""Points that score the starts."""
WIDE_GAIN, LOST_GAIN = 0.03, 0.1
"""Gain in the share of inliers from which a wider search is preferred."""


@dataclass(frozen=True, slots=True)
class Step:
    """The motion from one node to the next by scan matching.

    Attributes:
        relative: pose of the new node in the frame of the one before; the odometry's if a check failed.
        checks: checks of the registration.
        contradicts_odometry: whether a good registration says that the odometry is wrong.
        inliers, fit: shares of the registration, measured even if it failed; see `Alignment`.
        scatter: covariance (3, 3) of the new node's pose relative to the submap, in the node's own frame, m^2 and rad^2.
    """

    relative: RelativePose
    checks: tuple[Check, ...]
    contradicts_odometry: bool
    inliers: float
    fit: float
    scatter: Array

    @property
    def measured(self) -> bool:
        """Whether the motion comes from the registration and not from the odometry."""
        return passed(self.checks)


class Tracker:
    """Registers each new node to the submap of the nodes just before it."""

    def __init__(self, atlas: Atlas) -> None:
        self._atlas = atlas

    def step(
        self,
        cloud: Cloud,
        odometry: RelativePose,
        between_nodes: Callable[[], Iterable[tuple[Array, Cloud]]],
        last: int,
    ) -> Step:
        """Measure the motion from the last node to a new one; the atlas is not changed.

        Args:
            cloud: scan of the new node, in its frame.
            odometry: pose of the new node in the frame of the last node, by the wheels.
            between_nodes: returns the scans between the two nodes in order: the robot's pose (3,) in the frame of the last node
                by the wheels, and the cloud in the robot's frame. It is called only where the first search is weak.
            last: the last node: that of the atlas, or the one on which the robot was followed.
        """
        field = self._field(last)
        best = self._search(field, cloud, odometry.delta)
        if self._is_weak(best, odometry.delta):
            stepped = self._step_by_step(field, cloud, odometry.delta, between_nodes(), last)
            best = _better(best, stepped, 0.0)
        if self._is_weak(best, odometry.delta):
            best = _better(best, self._grid(field, cloud, odometry.delta, LOST), LOST_GAIN)
        return self._judge(best, odometry, last)

    def recognise(self, node: int, cloud: Cloud, expected: Array) -> RelativePose | None:
        """Register a scan to those about an older node, near an expected pose (3,) in its frame; nothing is changed.

        Returns the pose of the scan in the frame of the node; None if it does not fit well, not surely, or not near there.
        """
        nodes = self._atlas.along(node, ABOUT_M, ABOUT_M)
        found = self._grid(self._field_of(self._atlas.submap(node, nodes).cloud), cloud, expected, NARROW)
        covariance = found.covariance(0, FLOOR_M, np.deg2rad(FLOOR_DEG))
        loosest_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1]))
        fits = found.inliers[0] >= checks.INLIERS_MIN and loosest_m <= checks.LOOSEST_MAX_M
        if not fits or contradicts(found.poses[0], expected):
            return None
        return self._atlas.joining(node, found.poses[0], covariance)

    def pair(self, cloud: Cloud, following: Cloud, odometry: Array) -> Alignment:
        """Register one scan (`following`) to the scan before it (`cloud`), each in the robot's own frame.

        `odometry` (3,) is the expected pose of the following scan in the frame of the one before, m and rad.
        """
        field = self._field_of(cloud)
        best = self._search(field, following, odometry)
        if self._is_weak(best, odometry):
            best = _better(best, self._grid(field, following, odometry, LOST), LOST_GAIN)
        return best

    def resume(self, last: int, cloud: Cloud, expected: Array) -> Alignment:
        """Register a scan to the submap that ends at an earlier node (`last`), near an expected pose; nothing is changed.

        `expected` (3,) is the pose of the scan in the frame of `last`, m and rad.
        """
        nodes = range(max(last + 1 - SUBMAP_NODES, self._atlas.piece(last).start), last + 1)
        return self._grid(self._field_of(self._atlas.submap(last, nodes).cloud), cloud, expected, RESUMED)

    def _is_weak(self, alignment: Alignment, expected: Array) -> bool:
        """Whether a registration is weak, or contradicts the odometry without being very good."""
        inliers = alignment.inliers[0]
        return bool(inliers < checks.INLIERS_MIN or (inliers < INLIERS_SURE and contradicts(alignment.poses[0], expected)))

    def _field(self, last: int, extra: Sequence[Cloud] = ()) -> LikelihoodField:
        piece = self._atlas.piece(last)
        first, stop = last + 1 - SUBMAP_NODES, last + 1
        if stop < len(self._atlas):  # the robot was followed on it: what came after it is as near as what came before
            first, stop = last - SUBMAP_NODES // 2, last + 1 + SUBMAP_NODES // 2
        nodes = range(max(first, piece.start), min(stop, piece.stop))
        cloud = self._atlas.submap(last, nodes).cloud
        if extra:
            cloud = merged([cloud, *extra])
        return self._field_of(cloud)

    def _field_of(self, cloud: Cloud) -> LikelihoodField:
        return build_field(cloud, search_m=LOST.half_m + 2 * cloud.cell_m)

    def _search(self, field: LikelihoodField, cloud: Cloud, expected: Array) -> Alignment:
        """Search narrowly; if that is weak or contradicts the odometry, widely too, and take the one of more inliers."""
        narrow = self._grid(field, cloud, expected, NARROW)
        if narrow.inliers[0] >= checks.INLIERS_MIN and not contradicts(narrow.poses[0], expected):
            return narrow
        return _better(narrow, self._grid(field, cloud, expected, WIDE), WIDE_GAIN)

    def _grid(self, field: LikelihoodField, cloud: Cloud, expected: Array, window: SearchWindow) -> Alignment:
        sigma_m, sigma_rad = window.prior_m, np.deg2rad(window.prior_deg)
        headings, offsets = np.deg2rad(spaced(window.half_deg, GRID_DEG)), square(window.half_m, GRID_M)
        scores = score_starts(field, cloud.thinned(SCORED_POINTS).points, expected[:2], expected[2] + headings, offsets)
        scores -= PULL * (headings[:, None] / sigma_rad) ** 2
        scores -= PULL * ((offsets / (2.0 * sigma_m)) ** 2).sum(axis=1)[None]
        h, t = np.unravel_index(int(np.argmax(scores)), scores.shape)
        start = np.array([*(expected[:2] + offsets[t]), expected[2] + headings[h]])
        prior = Prior(expected, sigma_m, float(sigma_rad))
        return align(field, cloud, start[None], prior)

    def _step_by_step(
        self,
        field: LikelihoodField,
        cloud: Cloud,
        odometry: Array,
        between_nodes: Iterable[tuple[Array, Cloud]],
        last_node: int,
    ) -> Alignment:
        """Register the scans between the nodes one by one, each becoming part of the submap of the next."""
        pose, last = IDENTITY, IDENTITY
        seen: list[Cloud] = []
        for motion, scan in between_nodes:
            alignment = self._search(field, scan, compose(pose, between(last, motion)))
            pose, last = alignment.poses[0], motion
            if alignment.inliers[0] >= checks.INLIERS_WEAK:
                seen.append(scan.moved(pose))
                field = self._field(last_node, seen)
        return self._search(field, cloud, compose(pose, between(last, odometry)))

    def _judge(self, alignment: Alignment, odometry: RelativePose, last: int) -> Step:
        pose, inliers, fit = alignment.poses[0], float(alignment.inliers[0]), float(alignment.fit[0])
        off_m = float(np.hypot(*(pose - odometry.delta)[:2]))
        asked = checks.of_step(inliers, off_m)
        if not passed(asked):
            return Step(odometry, asked, False, inliers, fit, odometry.covariance)
        covariance = alignment.covariance(0, FLOOR_M, np.deg2rad(FLOOR_DEG))
        if self._is_weak(alignment, odometry.delta):
            covariance = covariance + np.diag([WEAK_M**2, WEAK_M**2, np.deg2rad(WEAK_DEG) ** 2])
        wrong = bool(inliers >= checks.INLIERS_MIN and contradicts(pose, odometry.delta))
        edge = self._atlas.joining(last, pose, covariance)
        return Step(edge, asked, wrong, inliers, fit, covariance)


def contradicts(pose: Array, expected: Array) -> bool:
    """Whether a registered pose (3,) is so far from that by the odometry (3,), m and rad, that the odometry is wrong.

    The registration is taken for good.
    """
    off_m = float(np.hypot(*(pose - expected)[:2]))
    return bool(off_m > CONTRADICTION_M or abs(wrap_angle(pose[2] - expected[2])) > np.deg2rad(CONTRADICTION_DEG))


def _better(first: Alignment, second: Alignment, gain: float) -> Alignment:
    """The second registration if it has more inliers by that much, else the first."""
    return second if second.inliers[0] > first.inliers[0] + gain else first
