"""Loops that are measured once more: where a closure has moved nodes, and where a back-end gives a loop no weight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hybridmap.geometry import Array, RelativePose, between, log, wrap_angle
from hybridmap.graph.edges import Edge, passed
from hybridmap.vision.base import Belief
from hybridmap.vision.rgbd import checks
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.pnp import Verification, Verifier

MAP_SIGMA_M, MAP_SIGMA_DEG = 0.15, 3.0
"""How far an optimised map may be off between nodes that lie side by side (one standard deviation), m and degrees."""


class Revisits:
    """Nodes to be compared again after a loop closure: it has moved them on the map, so they may now lie near old nodes."""

    def __init__(self) -> None:
        self._waiting: list[tuple[int, Array]] = []

    def closed(self, node: int, since_m: float, belief: Belief) -> None:
        """Note that a node closed a loop.

        Args:
            node: the node.
            since_m: path length at the loop closure before, m; of the nodes before `node`, those made since may have moved.
            belief: the map before the new closure.
        """
        behind = np.flatnonzero(belief.travel_m[:node] > since_m)
        self._waiting += [(int(n), belief.poses_map_node[n].copy()) for n in behind]

    def next_moved(self, belief: Belief) -> int | None:
        """Remove and return the newest waiting node that has moved on the map; None if there is none left.

        Newer ones that have not moved are removed too.
        """
        while self._waiting:
            node, before = self._waiting.pop()
            now = belief.poses_map_node[node]
            moved_m, turned = float(np.hypot(*(now - before)[:2])), float(abs(wrap_angle(now[2] - before[2])))
            if moved_m > MAP_SIGMA_M or turned > np.deg2rad(MAP_SIGMA_DEG):
                return node
        return None


class Reverification:
    """Measures loops again that a back-end treats as outliers.

    If the views fit at the map's pose, the loop takes the new measurement. If they fit at another pose only, the loop is kept
    if the covariance of the map without outliers allows that pose. In all other cases the loop is retracted.
    """

    def __init__(self, keyframes: Sequence[Keyframe], verifier: Verifier, map_covariance: Array) -> None:
        """`map_covariance` (3, 3): error of the map's relative pose of nodes that lie side by side, m and rad."""
        self._keyframes = keyframes
        self._verifier = verifier
        self._map_covariance = map_covariance

    def measure(self, outlier: Edge, belief: Belief) -> Verification:
        """Measure one loop again; `belief` is that of the map without outliers. Without a pose the loop is to be retracted."""
        source, target = self._keyframes[outlier.source], self._keyframes[outlier.target]
        on_map = between(belief.poses_map_node[outlier.source], belief.poses_map_node[outlier.target])
        there = self._verifier.verify_near(source, target, RelativePose(on_map, self._map_covariance))
        if there.relative is not None:
            return there
        elsewhere = self._verifier.verify(source, target)
        if elsewhere.relative is None:
            figures = {**there.figures, **elsewhere.figures}
            return replace(elsewhere, checks=there.checks + elsewhere.checks, lack=there.lack, figures=figures)
        spread = belief.covariance_from(outlier.source)[outlier.target] + self._map_covariance
        return _weighed(elsewhere, elsewhere.relative, on_map, spread)


def _weighed(found: Verification, relative: RelativePose, on_map: Array, spread: Array) -> Verification:
    """A measurement tested against the covariance `spread` (3, 3) of the map, infinite where that is unknown."""
    error = log(between(on_map, relative.delta))
    off_m, off_deg = float(np.hypot(error[0], error[1])), float(np.rad2deg(abs(error[2])))
    squared = 0.0
    if np.isfinite(spread).all():
        squared = float(error @ np.linalg.solve(spread + relative.covariance, error))
    asked = found.checks + checks.of_map(float(np.sqrt(squared)))
    figures = {**found.figures, "off_m": off_m, "off_deg": off_deg}
    return replace(found, relative=relative if passed(asked) else None, checks=asked, figures=figures)
