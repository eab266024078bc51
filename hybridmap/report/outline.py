"""The points of keyframes seen from above, and a picture of the building made of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, transform_points
from hybridmap.store import MapStore
from hybridmap.streams.base import Rig
from hybridmap.streams.sensors import see

_HEIGHTS_M = (0.1, 2.0)
_DEPTH_POINTS = 4000
_MAX_DEPTH_M = 6.0
_MAX_KEYFRAMES = 1500
_PIXELS = 900
_FAINTEST = 0.3


@dataclass(frozen=True, slots=True)
class Raster:
    """A grey picture of the building from above.

    Attributes:
        grey: (H, W) in [0, 1], 0 without points; row 0 is the lowest y.
        extent: left, right, bottom and top edge, m.
    """

    grey: NDArray[np.float32]
    extent: tuple[float, float, float, float]


def outline(keyframe: Mapping[str, NDArray[Any]], rig: Rig) -> Array:
    """Points (M, 2) that the sensors saw at one node, from above, in `base_link`, m; empty without any.

    Of a laser all of them; of a camera some thousand up to 6 m away and between 0.1 and 2 m above the floor.

    Args:
        keyframe: sensor data stored with the node, by name.
        rig: the robot's sensors.
    """
    seen = see(keyframe, rig, _MAX_DEPTH_M)
    if seen is None:
        return np.zeros((0, 2))
    if seen.bearings is not None:
        return seen.xyz[:, :2]
    walls = seen.xyz[(seen.xyz[:, 2] > _HEIGHTS_M[0]) & (seen.xyz[:, 2] < _HEIGHTS_M[1]), :2]
    return walls[:: max(1, len(walls) // _DEPTH_POINTS)]


def outlines(store: MapStore, count: int) -> dict[int, Array]:
    """Node -> points (M, 2) that the sensors saw there, in `base_link`, m; a node without points is left out.

    Args:
        store: the session's map file.
        count: number of nodes in the map. Of more than 1500 only evenly spaced ones are read.
    """
    rig = store.rig
    step = max(1, -(-count // _MAX_KEYFRAMES))
    found = {node: outline(store.keyframe(node), rig) for node in range(0, count, step)}
    return {node: points for node, points in found.items() if len(points)}


def raster(points_of: Mapping[int, Array], poses: Array) -> Raster | None:
    """Draw the points of every node at its pose, in one grey picture.

    Args:
        points_of: node -> its points, (M, 2) in `base_link`, m; a node without a pose is left out.
        poses: (N, 3) poses of the nodes 0 to N - 1 in the frame of the picture, m and rad.

    Returns:
        The picture; None if no node has points. A few outlying points may lie beyond its edges.
    """
    placed = [transform_points(poses[node], points) for node, points in points_of.items() if node < len(poses)]
    if not placed:
        return None
    points = np.concatenate(placed)
    low, high = np.percentile(points, [0.2, 99.8], axis=0)
    low, high = low - 0.5, high + 0.5
    cell_m = max(0.02, float((high - low).max()) / _PIXELS)
    bins = np.maximum(np.ceil((high - low) / cell_m).astype(int), 1)
    top = low + bins * cell_m
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=tuple(bins), range=np.stack([low, top], axis=1))
    seen = counts[counts > 0]
    full = float(np.percentile(seen, 90)) if len(seen) else 1.0
    strength = np.minimum(np.log1p(counts.T) / np.log1p(full), 1.0)
    grey = np.where(counts.T > 0, _FAINTEST + (1.0 - _FAINTEST) * strength, 0.0).astype(np.float32)
    return Raster(grey, (float(low[0]), float(top[0]), float(low[1]), float(top[1])))
