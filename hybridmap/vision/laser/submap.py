"""Old submaps as targets of registration, built once from the chain and kept while there is room."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.laser import LaserConfig
from hybridmap.geometry import Array, between
from hybridmap.vision.laser.cloud import Cloud, merged
from hybridmap.vision.laser.likelihood import LikelihoodField, build_field

WIDE = (0.2, 0.8, 0.4)
SHARP = (0.1, 0.5, 0.2)


@dataclass(frozen=True, slots=True)
class Submap:
    """Nodes about an anchor, in the anchor's frame.

    Attributes:
        anchor: node whose frame it is.
        nodes: its nodes.
        poses: (N, 3) of them in the anchor's frame.
        cloud: their points.
    """

    anchor: int
    nodes: NDArray[np.int64]
    poses: Array
    cloud: Cloud

    def viewpoints(self, count: int) -> NDArray[np.int64]:
        """At most `count` positions in `nodes`, evenly spread."""
        n = len(self.nodes)
        return np.unique(np.linspace(0, n - 1, min(count, n)).round().astype(np.int64))


@dataclass(frozen=True, slots=True)
class Target:
    """A submap with its fields: a wide and a sharp one to score starts on, a fine one to register to."""

    submap: Submap
    wide: LikelihoodField
    sharp: LikelihoodField
    fine: LikelihoodField


class Atlas:
    """The clouds of all nodes with the chain of refined poses; makes submaps and targets of them."""

    def __init__(self, config: LaserConfig, targets_kept: int = 160) -> None:
        self._config = config
        self._kept = targets_kept
        self._targets: OrderedDict[tuple[int, int, int, float], Target] = OrderedDict()
        self.clouds: list[Cloud] = []
        self.ranges: list[NDArray[np.float32]] = []
        self.chain: list[Array] = []
        self.travel_m: list[float] = []

    def __len__(self) -> int:
        return len(self.clouds)

    def add(self, cloud: Cloud, ranges_m: NDArray[np.float32], pose: Array) -> None:
        """Append a node by its pose (3,) in the chain."""
        step = float(np.hypot(*(pose - self.chain[-1])[:2])) if self.chain else 0.0
        self.travel_m.append(self.travel_m[-1] + step if self.travel_m else 0.0)
        self.clouds.append(cloud)
        self.ranges.append(ranges_m)
        self.chain.append(pose)

    def along(self, low_m: float, high_m: float) -> NDArray[np.int64]:
        """Nodes whose travel lies in [low, high], as far as there are any."""
        first = int(np.searchsorted(self.travel_m, low_m - 1e-9))
        stop = int(np.searchsorted(self.travel_m, high_m + 1e-9, side="right"))
        return np.arange(first, stop)

    def submap(self, anchor: int, nodes: NDArray[np.int64] | Sequence[int] | range) -> Submap:
        """Merge the clouds of some nodes in the frame of an anchor."""
        numbers = np.asarray(nodes, dtype=np.int64)
        poses = between(self.chain[anchor], np.array([self.chain[i] for i in numbers]).reshape(-1, 3))
        cloud = merged([self.clouds[i].moved(p) for i, p in zip(numbers, poses, strict=True)], self._config.scan.cell_m)
        return Submap(anchor, numbers, poses, cloud)

    def target(self, anchor: int, nodes: NDArray[np.int64], search_m: float) -> Target:
        """The submap of those nodes with its fields, from the cache if it is there."""
        key = (anchor, int(nodes[0]), int(nodes[-1]), search_m)
        if key in self._targets:
            self._targets.move_to_end(key)
            return self._targets[key]
        submap, settings = self.submap(anchor, nodes), self._config.registration
        target = Target(
            submap,
            build_field(submap.cloud, *WIDE, search_m),
            build_field(submap.cloud, *SHARP, search_m),
            build_field(submap.cloud, self._config.scan.cell_m, settings.reach_m, settings.field_sigma_m),
        )
        self._targets[key] = target
        while len(self._targets) > self._kept:
            self._targets.popitem(last=False)
        return target
