"""The robot's footprint, where it was driven, and the cells that it freed: where a robot has been, there is no obstacle."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import ExportError
from hybridmap.geometry import Array, compose, interpolate, wrap_angle
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.gaps import kidnappings
from hybridmap.store.track import Track, trajectory_of
from hybridmap.trajectory import Anchors

_DISC_CORNERS = 32
_SHIFT = 4
"""Fractional bits of OpenCV's polygon corners."""
_MAX_ROBOT_M = 20.0


@dataclass(frozen=True, slots=True)
class Footprint:
    """The outline of the robot on the floor.

    Attributes:
        corners: (C, 2) of a convex polygon in `base_link`, m, counter-clockwise.
        radius_m: radius of the largest disc round `base_link` within it: where the disc does not fit, no heading fits.
    """

    corners: Array
    radius_m: float

    @classmethod
    def disc(cls, radius_m: float) -> Self:
        """The footprint of a round robot."""
        angle = 2.0 * np.pi * np.arange(_DISC_CORNERS) / _DISC_CORNERS
        reach = radius_m / np.cos(np.pi / _DISC_CORNERS)
        return cls(reach * np.stack([np.cos(angle), np.sin(angle)], axis=1), radius_m)

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read a radius (`0.2`) or the corners of a polygon (`0.3,0.2 -0.3,0.2 -0.3,-0.2 0.3,-0.2`), m; of these the hull.

        Raises:
            ExportError: anything else, or `base_link` is not inside the polygon.
        """
        import cv2

        try:
            rows = [[float(number) for number in corner.split(",")] for corner in text.split()]
        except ValueError:
            rows = []
        flat = np.array([number for row in rows for number in row])
        if (
            len(flat) == 0
            or not (np.abs(flat) <= _MAX_ROBOT_M).all()
            or [len(row) for row in rows] not in ([1], [2] * len(rows))
        ):
            raise ExportError(f"footprint {text!r}: expected a radius in m, or at least three corners as `x,y x,y x,y`, m")
        if len(rows[0]) == 1:
            if flat[0] <= 0.0:
                raise ExportError(f"footprint {text!r}: expected a radius above 0 m")
            return cls.disc(float(flat[0]))
        hull = cv2.convexHull(np.array(rows, dtype=np.float32))
        inside_m = float(cv2.pointPolygonTest(hull, (0.0, 0.0), True)) if len(hull) > 2 else -1.0
        if inside_m <= 0.0:
            raise ExportError(f"footprint {text!r}: the corners must lie round base_link, (0, 0)")
        return cls(np.asarray(hull.reshape(-1, 2), dtype=np.float64), inside_m)

    @property
    def reach_m(self) -> float:
        """Distance from `base_link` to the farthest corner, m."""
        return float(np.hypot(*self.corners.T).max())


def driven(tracks: Sequence[Track], experiences: ExperienceMap, poses: Array) -> list[Array]:
    """The stretches on which the robot drove by itself: poses (K, 3) of each in `map`, m and rad.

    It is not known where the robot went while it was carried, so a stretch ends at a kidnapping. Beside the poses at every
    stamp, each node is a stretch of its own: a map without a track has its nodes.

    Args:
        tracks: of every session of the map. What is seen from nodes beyond `poses` is left out.
        experiences: the map; it may have grown beyond `poses`.
        poses: (N, 3) of its first nodes, m and rad.
    """
    return [*(stretch for track in tracks for stretch in _stretches(track, experiences, poses)), *poses[:, None]]


def _stretches(track: Track, experiences: ExperienceMap, poses: Array) -> Iterator[Array]:
    known = track.nodes < len(poses)
    if not known.any():
        return
    t, anchors = track, _known(track.anchors, len(poses))
    way = trajectory_of(Track(t.stamps_ns[known], t.nodes[known], t.deltas[known], t.poses_odom[known], anchors), poses)
    first, last = int(track.nodes.min()), int(track.nodes.max())
    number, carried = np.zeros(len(way), dtype=np.int64), np.zeros(len(way), dtype=bool)
    for one in kidnappings(experiences):
        if first <= one.before and one.after <= last:
            down = way.stamps_ns >= experiences.node(one.after).stamp_ns
            number += down
            carried |= (way.stamps_ns > experiences.node(one.before).stamp_ns) & ~down
    for part in range(int(number.max()) + 1):
        stretch = way.poses[(number == part) & ~carried]
        if len(stretch):
            yield stretch


def _known(anchors: Anchors, n_nodes: int) -> Anchors:
    """The anchors between the first nodes."""
    kept, a = anchors.next_nodes < n_nodes, anchors
    return Anchors(a.stamps_ns[kept], a.nodes[kept], a.next_nodes[kept], a.deltas[kept], a.next_deltas[kept])


def swept(
    shape: tuple[int, int], origin_m: Array, resolution_m: float, stretches: Sequence[Array], footprint: Footprint
) -> NDArray[np.bool_]:
    """(H, W) cells of a grid that the footprint touched. The cost grows with the way over the side of a cell.

    Args:
        shape, origin_m, resolution_m: of the grid, as `OccupancyGrid` has them.
        stretches: poses (K, 3) of each stretch, between which the robot drove; m and rad.
        footprint: the robot.
    """
    import cv2

    covered = np.zeros(shape, np.uint8)
    outline = np.column_stack([footprint.corners, np.zeros(len(footprint.corners))])
    for stretch in stretches:
        for pose in _resampled(stretch, 0.5 * resolution_m, footprint.reach_m):
            cells = (compose(pose, outline)[:, :2] - origin_m) / resolution_m - 0.5
            cv2.fillConvexPoly(covered, np.rint(cells * (1 << _SHIFT)).astype(np.int32), 1, shift=_SHIFT)
    return covered > 0


def _resampled(poses: Array, step_m: float, reach_m: float) -> Array:
    """Poses along a stretch (K, 3) with no corner of the robot moving more than a step from one to the next."""
    moved = np.hypot(*np.diff(poses[:, :2], axis=0).T) + reach_m * np.abs(wrap_angle(np.diff(poses[:, 2])))
    way = np.concatenate([[0.0], np.cumsum(moved)])
    at = np.append(np.arange(0.0, way[-1], step_m), way[-1])
    before = np.clip(np.searchsorted(way, at, side="right") - 1, 0, max(len(way) - 2, 0))
    after = np.minimum(before + 1, len(way) - 1)
    share = (at - way[before]) / np.maximum(way[after] - way[before], 1e-12)
    return interpolate(poses[before], poses[after], np.clip(share, 0.0, 1.0))
