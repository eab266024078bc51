"""Panoramic profiles: the scanline of what lies all around a node, and where on the map it was seen before.

A laser that looks ahead sees a place from one side only. The scans of some metres together show all of it, so that the profile
knows the place again from any side. The shift tells the heading, the old node about where the robot is.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, between, compose, wrap_angle
from hybridmap.vision.laser.submap import Atlas
from hybridmap.vision.profile import Profile, panoramic_profile
from hybridmap.vision.search import Nearest, ProfileIndex

Indices = NDArray[np.int64]

EVERY_M, HALF_M = 1.0, 4.0
"""Travel between the nodes with a panorama, and that its scans cover to either side, m."""
EVERY_NODE = 2
"""Of these nodes every second one takes part: neighbours see the same."""
APART_M = 12.0
"""Travel between two passes, m: a panorama is compared with those that are older by more."""
ALIKE = 16
"""Number of old panoramas that are proposed for each: the most similar on the whole map."""
AGREE_M, AGREE_RAD = 1.0, float(np.deg2rad(12.0))
"""Panoramas agree if they put the probe at the same pose, m and rad: that far a place looks alike."""


@dataclass(frozen=True, slots=True)
class Leads:
    """Where profiles put a node: n proposals, one for each pair of a panorama near it and an old one.

    Attributes:
        panoramas: (n,) numbers of the panoramas.
        old: (n,) nodes of the old panoramas.
        poses: (n, 3) of the node in the frame of the chain, as the old pass has it, m and rad.
        differences: (n,) of the two profiles.
    """

    panoramas: Indices
    old: Indices
    poses: Array
    differences: Array

    def where(self, chosen: NDArray[np.bool_] | Indices) -> Leads:
        """Some of the leads."""
        return Leads(self.panoramas[chosen], self.old[chosen], self.poses[chosen], self.differences[chosen])

    def agreed(self) -> list[tuple[int, Array]]:
        """Groups of leads that put the node at the same pose: an old node and that pose (3,).

        Those on which the most panoramas agree come first, of these the ones whose profiles differ least.
        """
        gaps = self.poses[:, None] - self.poses[None]
        same = (np.hypot(gaps[..., 0], gaps[..., 1]) < AGREE_M) & (np.abs(wrap_angle(gaps[..., 2])) < AGREE_RAD)
        ballots = self.panoramas[:, None] == np.unique(self.panoramas)
        order = np.argsort(self.differences, kind="stable")
        left, out = np.ones(len(self.old), dtype=bool), []
        while left.any():
            votes = ((same & left) @ ballots).sum(axis=1) * left
            best = int(order[np.argmax(votes[order])])
            group = np.flatnonzero(same[best] & left)
            left[group] = False
            offset = self.poses[group] - self.poses[best]
            offset[:, 2] = wrap_angle(offset[:, 2])
            out.append((int(self.old[best]), self.poses[best] + offset.mean(axis=0)))
        return out


class Panoramas:
    """The panoramic profiles of a drive. The search for old ones costs a time that grows with their number.

    Attributes:
        nodes: the nodes that have a panorama, ascending: the first one from each metre of travel on.
    """

    def __init__(self, atlas: Atlas, width: int, proposed: int = ALIKE) -> None:
        """Start without a panorama of `width` columns; `proposed` old ones are proposed for each, with 0 none is compared."""
        self._proposed = proposed
        self._atlas = atlas
        self._width = width
        self._index = ProfileIndex(np.full(2, 0.5), width, max_shift=0, circular=True)
        self._alike: list[Nearest] = []
        self.nodes: list[int] = []

    def extend(self, to_the_end: bool = False) -> None:
        """Make the panoramas of nodes that the robot has left by half of the way that a panorama covers, or of all nodes."""
        travel = self._atlas.travel_m
        if not travel:
            return
        last_m = travel[-1] - (0.0 if to_the_end else HALF_M)
        while (node := self._next()) < len(travel) and travel[node] <= last_m:
            self._add(node)

    def alike(self, number: int) -> Nearest:
        """The old panoramas on the whole map that are most similar to one, the best first; their numbers, not their nodes."""
        return self._alike[number]

    def leads(self, node: int, near: Sequence[int] | Indices) -> Leads:
        """Where the panoramas of the nodes `near`, ascending, put a node of their piece of the atlas."""
        numbers = range(bisect_left(self.nodes, int(near[0])), bisect_left(self.nodes, int(near[-1]) + 1))
        found = [self._alike[number] for number in numbers]
        if not sum(len(one.numbers) for one in found):
            nothing = np.zeros(0, dtype=np.int64)
            return Leads(nothing, nothing, np.zeros((0, 3)), np.zeros(0))
        panoramas = np.repeat(np.array(numbers), [len(one.numbers) for one in found])
        chain = self._atlas.chain
        old = np.array([self.nodes[i] for one in found for i in one.numbers.tolist()])
        turned = np.zeros((len(old), 3))
        turned[:, 2] = -2.0 * np.pi / self._width * np.concatenate([one.shift for one in found])
        onward = between(np.array([chain[self.nodes[i]] for i in panoramas.tolist()]), chain[node])
        poses = compose(compose(np.array([chain[i] for i in old.tolist()]), turned), onward)
        return Leads(panoramas, old, poses, np.concatenate([one.distance for one in found]))

    def _next(self) -> int:
        """The node that is next to have a panorama: the first one from the next whole multiple of `EVERY_M` on."""
        travel = self._atlas.travel_m
        wanted = EVERY_M * (np.floor(travel[self.nodes[-1]] / EVERY_M) + 1.0) if self.nodes else 0.0
        return bisect_left(travel, wanted)

    def _add(self, node: int) -> None:
        travel, older = self._atlas.travel_m, 0
        profile = self._profile(node) if self._proposed else np.zeros((2, self._width), dtype=np.float32)
        if self._proposed:
            older = bisect_left(self.nodes, bisect_left(travel, travel[node] - APART_M))
        self._alike.append(self._index.nearest(profile, self._proposed, np.arange(older)))
        self._index.add(profile)
        self.nodes.append(node)

    def _profile(self, node: int) -> Profile:
        around = self._atlas.along(node, HALF_M, HALF_M)[::EVERY_NODE]
        points = [self._atlas.clouds[i].points for i in around.tolist()]
        poses = between(self._atlas.chain[node], np.array([self._atlas.chain[i] for i in around.tolist()]))
        each = np.repeat(poses, [len(p) for p in points], axis=0)
        cos, sin = np.cos(each[:, 2]), np.sin(each[:, 2])
        x, y = np.concatenate(points).T
        return panoramic_profile(np.column_stack([each[:, 0] + cos * x - sin * y, each[:, 1] + sin * x + cos * y]), self._width)
