"""One scan as points with normals in `base_link`, many merged into one cloud, and the likelihood field of a cloud.

The scale of the scene, from how far the walls are, tells how far scans are used and how coarse their points may be.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array
from hybridmap.streams.laser import Laser

RANGE_MAX_M = 20.0
"""Largest range used in rooms and corridors, m: beyond it the beams of most lasers are too far apart for normals."""
CELL_M = 0.05
"""Side of the cells whose points are merged there, m: a few times the noise of a range."""
REACH_MAX_M = 1.0
"""Largest distance of the neighbours that give a point its normal there, m."""
NEAR_M = 8.0
"""Where three quarters of the returns are this near, the scene has the scale 1: a large room, a hall of a house."""
LARGEST = 2.0
"""The largest scale: there the cells are 0.1 m, and a laser of 80 m is used whole."""
STEP = 0.5
"""The scale changes in such steps, so that a map has few kinds of clouds."""
SHARE = 0.75
"""Share of a scan's returns that lie within its typical range."""
SCANS = 60
"""The median over so many scans is the scene's: people and doors beside the robot do not change it."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Sizes in proportion to the scene.

    Attributes:
        factor: 1 indoors, up to `LARGEST` where the walls are far away.
    """

    factor: float = 1.0

    @property
    def cell_m(self) -> float:
        """Side of the cells whose points are merged, m; the residuals of a registration are judged by it."""
        return CELL_M * self.factor

    @property
    def range_max_m(self) -> float:
        """Largest range used, m. It grows faster than the cells: few returns are near, and far walls hold the heading."""
        return RANGE_MAX_M * self.factor**2

    @property
    def reach_max_m(self) -> float:
        """Largest distance of the neighbours that give a point its normal, m."""
        return REACH_MAX_M * self.factor**2


INDOORS = Scale()


class Scene:
    """Follows the scale of the scene, scan by scan, at a constant cost.

    Attributes:
        scale: the scale now.
    """

    def __init__(self) -> None:
        """Start without a scan, at the scale of a room."""
        self._typical_m: deque[float] = deque(maxlen=SCANS)
        self.scale = INDOORS

    def observe(self, ranges_m: NDArray[np.float32]) -> Scale:
        """Take in one scan (B,), m, NaN where there is no return; returns the scale now.

        The scale changes only when the scene's typical range has gone a whole step on, so it does not flicker between two. A
        scan without returns changes nothing.
        """
        returns = ranges_m[np.isfinite(ranges_m)]
        if len(returns):
            at = int(SHARE * (len(returns) - 1))
            self._typical_m.append(float(np.partition(returns, at)[at]))
            wanted = min(max(sorted(self._typical_m)[len(self._typical_m) // 2] / NEAR_M, 1.0), LARGEST)
            if abs(wanted - self.scale.factor) >= STEP:
                self.scale = Scale(STEP * round(wanted / STEP))
        return self.scale


REACH_M, REACH_BEAMS = 0.1, 8.0
"""Largest distance of neighbours, m: the first plus so many distances between beams, at most `Scale.reach_max_m`."""
THIN = 0.1
"""Largest variance of neighbours across their line, as a share of that along it."""
AGREEING = 0.3
"""Least length of the sum of the normals in a cell; below it they contradict each other, and the cell has none."""
NEIGHBOURS = 3
"""Beams to either side of a point that give it its normal."""
PARTNER_M = 0.3
"""Largest distance of a point from its partner, m: a chair's width, less than a corridor's."""
FIELD_SIGMA_M = 0.12
"""Width of the likelihood field on which starts are scored, m: about a step of the grid of starts."""


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points of walls, with normals towards the robot.

    Attributes:
        points: (P, 2) m, in `base_link` at the scan, or in the frame to which they were moved.
        normals: (P, 2) unit vectors; (0, 0) where the neighbours of a point are no line.
        cell_m: side of the cells whose points were merged, m.
    """

    points: Array
    normals: Array
    cell_m: float = CELL_M

    def __len__(self) -> int:
        return len(self.points)

    def moved(self, pose_a_b: Array) -> Cloud:
        """The same cloud in frame a, where this one is given in frame b; `pose_a_b` is (3,), m and rad."""
        cos, sin = np.cos(pose_a_b[2]), np.sin(pose_a_b[2])
        turn = np.array([[cos, sin], [-sin, cos]])
        return Cloud(self.points @ turn + pose_a_b[:2], self.normals @ turn, self.cell_m)

    def thinned(self, count: int) -> Cloud:
        """The cloud with at most `count` of its points, evenly picked in their order."""
        if len(self) <= count:
            return self
        pick = (np.arange(count) * (len(self) / count)).astype(np.int64)
        return Cloud(self.points[pick], self.normals[pick], self.cell_m)


EMPTY = Cloud(np.zeros((0, 2)), np.zeros((0, 2)))


def cloud_of_scan(ranges_m: NDArray[np.float32], laser: Laser, scale: Scale = INDOORS) -> Cloud:
    """Points of one scan in `base_link`; points that fall into one grid cell are averaged.

    Ranges outside the limits of laser and scale are left out. With fewer than seven others the cloud is empty.

    Args:
        ranges_m: (B,) ranges, NaN where invalid.
        laser: bearings, limits and mounting.
        scale: of the scene; it gives the largest range and the cells.
    """
    return clouds_of_scans([ranges_m], laser, scale)[0]


def clouds_of_scans(ranges_m: Sequence[NDArray[np.float32]], laser: Laser, scale: Scale = INDOORS) -> list[Cloud]:
    """Clouds of many scans of (B,) ranges, one for each in their order: as `cloud_of_scan` gives them, but faster."""
    ranges = np.array(ranges_m, dtype=np.float64).reshape(len(ranges_m), -1)
    valid = (ranges >= laser.range_min_m) & (ranges <= min(laser.range_max_m, scale.range_max_m))
    valid &= valid.sum(axis=1, keepdims=True) >= 2 * NEIGHBOURS + 1
    scan, beam = np.nonzero(valid)
    if len(scan) == 0:
        return [EMPTY] * len(ranges_m)
    distance, bearing = ranges[scan, beam], laser.bearings_rad[beam]
    points = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=1)
    step = abs(float(laser.bearings_rad[-1] - laser.bearings_rad[0])) / max(len(laser.bearings_rad) - 1, 1)
    normals = _normals(points, np.minimum(scale.reach_max_m, REACH_M + REACH_BEAMS * step * distance), scan)
    whole, group = _merged(Cloud(points, normals).moved(laser.pose_base_laser), scan, scale.cell_m)
    ends = np.searchsorted(group, np.arange(len(ranges_m) + 1))
    return [Cloud(whole.points[a:b], whole.normals[a:b], whole.cell_m) for a, b in pairwise(ends.tolist())]


def merged(clouds: Iterable[Cloud], cell_m: float | None = None) -> Cloud:
    """Merge clouds of one frame; points that fall into one grid cell are averaged.

    Without `cell_m`, the coarsest cloud gives the side of the cells.
    The order of the result follows the cells, so it does not depend on the order of the clouds.
    """
    parts = [c for c in clouds if len(c)]
    if not parts:
        return EMPTY
    whole = Cloud(np.concatenate([c.points for c in parts]), np.concatenate([c.normals for c in parts]))
    return _merged(whole, np.zeros(len(whole), dtype=np.int64), cell_m or max(c.cell_m for c in parts))[0]


def merged_at(clouds: Sequence[Cloud], poses: Array) -> Cloud:
    """Merge N clouds, each in the frame of one of the poses (N, 3), into one, in the frame in which the poses are given.

    Points that fall into one grid cell are averaged. The coarsest cloud gives the side of the cells.
    """
    counts = [len(c) for c in clouds]
    if sum(counts) == 0:
        return EMPTY
    x, y = poses[:, 0].repeat(counts), poses[:, 1].repeat(counts)
    cos, sin = np.cos(poses[:, 2]).repeat(counts), np.sin(poses[:, 2]).repeat(counts)
    px, py = np.concatenate([c.points for c in clouds]).T
    nx, ny = np.concatenate([c.normals for c in clouds]).T
    points = np.stack([x + cos * px - sin * py, y + sin * px + cos * py], axis=1)
    normals = np.stack([cos * nx - sin * ny, sin * nx + cos * ny], axis=1)
    return _merged(Cloud(points, normals), np.zeros(len(points), dtype=np.int64), max(c.cell_m for c in clouds))[0]


def _merged(cloud: Cloud, group: NDArray[np.int64], cell_m: float) -> tuple[Cloud, NDArray[np.int64]]:
    """Merge points of one cell and one group; group numbers ascend along the points. Returns what is left, with its groups."""
    first = np.flatnonzero(np.diff(group, prepend=-1))
    low = np.zeros((int(group[-1]) + 1, 2))
    for i in (0, 1):
        low[group[first], i] = np.minimum.reduceat(cloud.points[:, i], first)
    cells = ((cloud.points - low[group]) / cell_m).astype(np.int64).T
    rows, columns = int(cells[0].max()) + 1, int(cells[1].max()) + 1
    key = (group * rows + cells[0]) * columns + cells[1]
    found, member, count = np.unique(key, return_inverse=True, return_counts=True)
    n = len(count)
    mean: Array = np.stack([np.bincount(member, cloud.points[:, i], n) / count for i in (0, 1)], axis=1)
    normal: Array = np.stack([np.bincount(member, cloud.normals[:, i], n) for i in (0, 1)], axis=1)
    length = np.sqrt(normal[:, 0] ** 2 + normal[:, 1] ** 2)
    normal = np.where((length > AGREEING)[:, None], normal / np.maximum(length, 1e-9)[:, None], 0.0)
    return Cloud(mean, normal, cell_m), found // (rows * columns)


def _normals(points: Array, reach_m: Array, scan: NDArray[np.int64]) -> Array:
    """Normal of the line through each point's neighbours in beam order, towards the laser at the origin; (P, 2).

    Args:
        points: (P, 2) of one scan after the other, in beam order.
        reach_m: (P,) how far a neighbour may lie.
        scan: (P,) number of the scan: neighbours are of the same.
    """
    n, reach = len(points), reach_m**2
    total, sums = np.ones(n), np.zeros((5, n))
    for k in range(1, min(NEIGHBOURS, n - 1) + 1):
        dx, dy = (points[k:] - points[:-k]).T
        terms = np.stack([dx, dy, dx * dx, dy * dy, dx * dy])
        squared, same = terms[2] + terms[3], scan[k:] == scan[:-k]
        ahead, behind = same & (squared <= reach[:-k]), same & (squared <= reach[k:])
        total[:-k] += ahead
        total[k:] += behind
        sums[:, :-k] += terms * ahead
        terms[:2] *= -1.0
        sums[:, k:] += terms * behind
    mx, my, xx, yy, xy = sums / total
    xx, yy, xy = xx - mx * mx, yy - my * my, xy - mx * my
    along = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    normal = np.stack([-np.sin(along), np.cos(along)], axis=1)
    spread = np.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)
    is_line = (total >= 3.0) & ((xx + yy - spread) <= THIN * (xx + yy + spread))
    normal *= np.where((normal * points).sum(axis=1) > 0.0, -1.0, 1.0)[:, None]
    return np.where(is_line[:, None], normal, 0.0)


@dataclass(frozen=True, slots=True)
class LikelihoodField:
    """A grid around a cloud that tells the nearest point and the likelihood of any position.

    Attributes:
        low: (2,) corner of cell (0, 0) in the cloud's frame, m.
        cell_m: side of a cell, m.
        shape: number of cells in x and y.
        margin: number of empty cells at each border, to which look-ups are clipped.
        labels: (cells,) int32, column of `lines` with the nearest point within reach, 0 for none.
        likelihood: (cells,) uint8, 255 exp(-d^2 / 2 sigma^2) of the distance d to that point.
        lines: (3, 1 + P) the line through each of the P points with a normal: its unit normal, and its distance from the origin
            along the normal, m; column 0 is zero and stands for no point.
    """

    low: Array
    cell_m: float
    shape: tuple[int, int]
    margin: int
    labels: NDArray[np.int32]
    likelihood: NDArray[np.uint8]
    lines: Array

    def cells(self, x: Array, y: Array) -> NDArray[np.int64]:
        """Flat cell numbers of coordinates (m, cloud's frame) of any shape; those outside fall on the empty border."""
        nx, ny = self.shape
        column = _bounded((x - self.low[0]) * (1.0 / self.cell_m), self.margin, nx - 1 - self.margin)
        row = _bounded((y - self.low[1]) * (1.0 / self.cell_m), self.margin, ny - 1 - self.margin)
        return np.asarray(column * ny + row)


def _bounded(cells: Array, low: int, high: int) -> NDArray[np.int64]:
    np.maximum(cells, low, out=cells)
    np.minimum(cells, high, out=cells)
    return cells.astype(np.int64)


def build_field(
    cloud: Cloud,
    cell_m: float | None = None,
    reach_m: float = PARTNER_M,
    sigma_m: float = FIELD_SIGMA_M,
    search_m: float = 0.0,
) -> LikelihoodField:
    """Build the likelihood field of a cloud; points without a normal are left out.

    Args:
        cloud: P points with normals.
        cell_m: side of a cell, m; None: that of the cloud.
        reach_m: largest distance from a point at which it has a likelihood, m.
        sigma_m: standard deviation of the likelihood, m.
        search_m: largest offset that `score_starts` will be given on this field, m.
    """
    cell_m = cell_m or cloud.cell_m
    usable = np.flatnonzero(cloud.normals[:, 0] ** 2 + cloud.normals[:, 1] ** 2 > 0.5)
    points, normals = cloud.points[usable].T, cloud.normals[usable].T
    reach, margin = int(np.ceil(reach_m / cell_m)), int(np.ceil(search_m / cell_m)) + 1
    border = reach + 2 * margin + 1
    if len(usable) == 0:
        points, normals = np.zeros((2, 1)), np.zeros((2, 1))
    low = np.array([coordinate.min() for coordinate in points]) - border * cell_m
    column, row = ((coordinate - least) / cell_m for coordinate, least in zip(points, low, strict=True))
    column, row = column.astype(np.int64), row.astype(np.int64)
    nx, ny = int(column.max()) + border + 1, int(row.max()) + border + 1
    offsets, distance_m = _disc(reach, cell_m)
    index = (column * ny + row)[None] + (offsets[:, 0] * ny + offsets[:, 1])[:, None]
    value = np.maximum(1.0, 255.0 * np.exp(-0.5 * (distance_m / sigma_m) ** 2)).astype(np.int32)
    both = np.zeros(nx * ny, np.int32)  # label and likelihood in one number: the scattered write is what costs
    if len(usable):  # else the one point only gives the grid a place
        both[index] = (np.arange(1, points.shape[1] + 1, dtype=np.int32) << 8)[None] | value[:, None]
    labels, likelihood = both >> 8, (both & 255).astype(np.uint8)
    lines = np.zeros((3, 1 + points.shape[1]))
    lines[:2, 1:], lines[2, 1:] = normals, normals[0] * points[0] + normals[1] * points[1]
    return LikelihoodField(low, cell_m, (nx, ny), margin, labels, likelihood, lines)


def _disc(reach: int, cell_m: float) -> tuple[NDArray[np.int64], Array]:
    """Cell offsets (O, 2) within reach and their length (O,) m, the longest first."""
    side = np.arange(-reach, reach + 1)
    offsets = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    length = np.sqrt((offsets**2).sum(axis=1).astype(np.float64))
    order = np.argsort(-length, kind="stable")
    order = order[length[order] <= reach]
    return offsets[order], length[order] * cell_m
