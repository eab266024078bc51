"""On which side of a kidnapping each scan was taken: single scans find the node before which the robot was carried."""

from __future__ import annotations

import numpy as np

from hybridmap.geometry import IDENTITY, Array, between, compose
from hybridmap.vision.base import Division
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.cloud import build_field
from hybridmap.vision.laser.hypotheses import LENGTH_M, TARGET_HALF_M
from hybridmap.vision.laser.kidnapping import OLD_M, OLD_NODES
from hybridmap.vision.laser.scan_matching import Prior, align
from hybridmap.vision.laser.submap import Atlas

STRETCH_M = LENGTH_M
"""Scans within this travel of the place are asked, m: a loop is measured by scans of as many metres, so that loops alone tell
the node of a kidnapping no better."""
MAP_M = LENGTH_M + TARGET_HALF_M
"""They are compared with scans of more travel from the place, m, which lie on one side of the kidnapping."""
LOOSE_M, LOOSE_RAD = 0.1, float(np.deg2rad(2.0))
"""Standard deviations of a scan's pose on the map, m and rad: the noise of a map that is right."""


def divide(atlas: Atlas, place: int, poses: Array) -> Division | None:
    """Find the first node after a kidnapping: scans before it fit the map where the chain has them, later ones elsewhere.

    The chain is followed from either side of the place. A scan is asked where the map has other scans at both of its poses.
    The cost grows with the number of scans within 20 m.

    Args:
        atlas: the scans.
        place: a node near the kidnapping.
        poses: (N, 3) of the nodes on a map whose chain is loose before `place`, m and rad.

    Returns:
        None if there is no scan to be asked, or the whole piece of the chain is on one side.
    """
    travel_m = np.asarray(atlas.travel_m)
    rest = np.flatnonzero(np.abs(travel_m - travel_m[place]) > MAP_M)
    asked = atlas.along(place, STRETCH_M, STRETCH_M)
    chain = np.array([atlas.chain[i] for i in asked.tolist()])
    before = compose(poses[place - 1], between(atlas.chain[place - 1], chain))
    after = compose(poses[place], between(atlas.chain[place], chain))
    fits = np.array(
        [[_fit(atlas, node, pose, poses, rest) for pose in pair] for node, *pair in zip(asked, before, after, strict=True)]
    )
    better = fits[:, 1] - fits[:, 0]
    if not np.isfinite(better).any():
        return None
    later = np.nan_to_num(better)[::-1].cumsum()[::-1]
    first = int(np.argmax(later))
    if asked[first] == atlas.piece(place).start:
        return None
    return Division(int(asked[first]), *checks.of_division(float(later[first])))


def _fit(atlas: Atlas, node: int, pose: Array, poses: Array, rest: np.ndarray[tuple[int], np.dtype[np.int64]]) -> float:
    """Share of a node's scan that fits the scans of the nodes `rest` about a pose (3,) on the map; NaN if there are none."""
    near = rest[np.hypot(*(poses[rest, :2] - pose[:2]).T) < OLD_M]
    if not len(near):
        return float("nan")
    field = build_field(atlas.about(pose, near, poses, OLD_NODES).cloud)
    prior = Prior(IDENTITY, LOOSE_M, LOOSE_RAD)
    return float(align(field, atlas.clouds[node], IDENTITY[None], prior).inliers[0])
