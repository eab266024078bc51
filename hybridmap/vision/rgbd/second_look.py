"""A loop that a back-end holds for false is measured once more, from where the map now has its nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hybridmap.geometry import Array, RelativePose, between, log
from hybridmap.graph.edges import Edge, passed
from hybridmap.vision.base import Belief
from hybridmap.vision.rgbd import checks
from hybridmap.vision.rgbd.keyframe import Keyframe
from hybridmap.vision.rgbd.pnp import Verification, Verifier


class SecondLook:
    """Decides what becomes of doubted loops.

    Where the two views fit as the map has them, the loop was measured wrongly and takes the new measurement. Where they fit in
    another way only, the loop and the map contradict each other: the loop stays if the map, left to its other edges, may
    be that wrong, and goes if it may not. Where they fit in no way it goes.
    """

    def __init__(self, keyframes: Sequence[Keyframe], verifier: Verifier, map_covariance: Array) -> None:
        """`map_covariance` (3, 3): how far the map may be off between nodes that lie side by side, m and rad."""
        self._keyframes = keyframes
        self._verifier = verifier
        self._map_covariance = map_covariance

    def measure(self, doubted: Edge, belief: Belief) -> Verification:
        """Measure one loop again; `belief` is that of the map without the loops that are doubted."""
        source, target = self._keyframes[doubted.source], self._keyframes[doubted.target]
        on_map = between(belief.poses_map_node[doubted.source], belief.poses_map_node[doubted.target])
        there = self._verifier.verify_near(source, target, RelativePose(on_map, self._map_covariance))
        if there.relative is not None:
            return there
        elsewhere = self._verifier.verify(source, target)
        if elsewhere.relative is None:
            figures = {**there.figures, **elsewhere.figures}
            return replace(elsewhere, checks=there.checks + elsewhere.checks, lack=there.lack, figures=figures)
        spread = belief.covariance_from(doubted.source)[doubted.target] + self._map_covariance
        return _weighed(elsewhere, elsewhere.relative, on_map, spread)


def _weighed(found: Verification, relative: RelativePose, on_map: Array, spread: Array) -> Verification:
    """A measurement off the map, held against how far the map may be off: `spread` (3, 3), infinite if anywhere."""
    error = log(between(on_map, relative.delta))
    off_m, off_deg = float(np.hypot(error[0], error[1])), float(np.rad2deg(abs(error[2])))
    squared = 0.0
    if np.isfinite(spread).all():
        squared = float(error @ np.linalg.solve(spread + relative.covariance, error))
    asked = found.checks + checks.of_map(float(np.sqrt(squared)))
    figures = {**found.figures, "off_m": off_m, "off_deg": off_deg}
    return replace(found, relative=relative if passed(asked) else None, checks=asked, figures=figures)
