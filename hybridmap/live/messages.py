"""What the robot's process and the mapping process say to each other, besides the samples themselves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.config import Config
from hybridmap.geometry import Array
from hybridmap.streams.base import Rig


@dataclass(frozen=True, slots=True)
class Begin:
    """The first message to the child: what to map with, and where to."""

    config: Config
    rig: Rig
    out: Path
    name: str
    overwrite: bool


@dataclass(frozen=True, slots=True)
class Dropped:
    """To the child: samples of a source were left out for a reason; for the figures and the verdict of the session."""

    source: str
    reason: str
    count: int


@dataclass(frozen=True, slots=True)
class Save:
    """To the child: write everything so far, and answer with the same number."""

    number: int


@dataclass(frozen=True, slots=True)
class Ask:
    """To the child: say how far you are."""


@dataclass(frozen=True, slots=True)
class Reset:
    """To the child: leave the map, and begin a new one in its place."""


@dataclass(frozen=True, slots=True)
class End:
    """To the child: the drive is over; conclude the session."""


@dataclass(frozen=True, slots=True)
class Ready:
    """To the robot: the mapper is set up, and its folder is held."""


@dataclass(frozen=True, slots=True)
class Done:
    """To the robot: how far the mapper is.

    Attributes:
        consumed: samples of this map that the mapper has taken in so far.
        mapped: views of which the mapper has done the step since the last message.
        busy_s: wall time that it needed for these, s.
        motion_s: wall time that it needs for a sample of odometry, s.
        pose_map_odom: (3,) the correction `map -> odom` now, m and rad.
    """

    consumed: int
    mapped: int
    busy_s: float
    motion_s: float
    pose_map_odom: Array


@dataclass(frozen=True, slots=True)
class Saved:
    """To the robot: what `Save` asked for is done."""

    number: int


@dataclass(frozen=True, slots=True)
class Failed:
    """To the robot: the mapper ended by an error; the name of its class, and its words."""

    error: str
    words: str


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The map at one moment. It never changes: a newer one takes its place as a whole.

    Attributes:
        stamp_ns: stamp of the newest step, ns; 0 before the first.
        stamps_ns: (N,) int64 stamps of the nodes, ns.
        poses: (N, 3) poses of the nodes in `map` by the primary back-end, m and rad.
        edges: (E, 2) int64 nodes that the accepted edges join.
        kinds: (E,) int8 kinds of these edges, values of `EdgeKind`.
        pose_map_odom: (3,) the correction `map -> odom`, m and rad.
        covariance: (3, 3) covariance of the newest node seen from the first, m^2 and rad^2, in its own frame; None without
            nodes.
        lost: whether the robot is kidnapped or lost track of its motion, and not found yet.
        graph_hash: hash of the graph; None before the end of the drive.
    """

    stamp_ns: int
    stamps_ns: NDArray[np.int64]
    poses: Array
    edges: NDArray[np.int64]
    kinds: NDArray[np.int8]
    pose_map_odom: Array
    covariance: Array | None = None
    lost: bool = False
    graph_hash: str | None = None

    def __post_init__(self) -> None:
        for array in (self.stamps_ns, self.poses, self.edges, self.kinds, self.pose_map_odom, self.covariance):
            if array is not None:
                array.setflags(write=False)

    def __reduce__(self) -> Any:  # arrays that cannot be written stay so on the other side
        return Snapshot, tuple(getattr(self, name) for name in self.__slots__)


def empty_snapshot() -> Snapshot:
    """The map before the first node."""
    return Snapshot(0, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2), np.int64), np.zeros(0, np.int8), np.zeros(3))
