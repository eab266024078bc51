"""A drive is looked for on a map that exists while it is driven: localisation on a known map, live."""

from __future__ import annotations

import numpy as np

from hybridmap.edge_book import Update
from hybridmap.errors import ConfigError
from hybridmap.geometry import Array, compose, inverse
from hybridmap.graph.edges import Edge, EdgeKind
from hybridmap.mapper import Mapper
from hybridmap.sessions.joining import config_of
from hybridmap.sessions.joint_map import JointMap, moved
from hybridmap.sessions.part import Part
from hybridmap.store import MapStore
from hybridmap.vision.base import MeetingFrontEnd
from hybridmap.vision.relocalising import placed_by

NEWEST = 8
"""The place on the known map is that which most of so many newest loops agree on."""


class KnownMap:
    """A finished map on which a mapper's drive is looked for, node by node, while it is driven.

    The drive begins as that of a robot that does not know where it is. The mapper maps as it would alone; what is found here
    changes nothing of its map, and nothing of the known one.

    ```python
    known = KnownMap(MapStore.open(folder))
    for update in mapper.add(sample):
        known.follow(mapper, update)
    pose_known_robot = known.pose(mapper.pose_map_robot)      # None until several views agree
    ```

    Attributes:
        found_after_m: travel of the drive at which its place was found, m; None before.
    """

    def __init__(self, store: MapStore) -> None:
        """Take up the map of a file, which may be closed afterwards.

        Raises:
            StoreError: the map is damaged or not finished.
            StreamError: its views cannot be taken up.
            ConfigError: its sensor can join no maps.
        """
        self._joint = JointMap(config_of(store), store.rig)
        self._known = len(self._joint.take_up(Part.of(store)))
        self._numbers: dict[int, int] = {}  # edge of the drive -> edge of the joint map
        self._sightings: list[Edge] = []
        self._pose_known_map: Array | None = None
        self.found_after_m: float | None = None

    @property
    def lost(self) -> bool:
        """Whether the place of the drive on the known map is not known."""
        return self._pose_known_map is None

    def pose(self, pose_map_robot: Array) -> Array | None:
        """(3,) where a pose (3,) on the mapper's map is on the known map, m and rad; None while that is not known."""
        return None if self._pose_known_map is None else compose(self._pose_known_map, pose_map_robot)

    def follow(self, mapper: Mapper, update: Update) -> bool:
        """Take in what the mapper did at one instant; returns whether the place on the known map was found or corrected.

        Call it with every update, in order, while the keyframe of a new node is still held. A new node costs what a search for
        loops costs; other updates cost next to nothing.

        Raises:
            ConfigError: the mapper's front-end cannot join maps.
        """
        node = update.new_node
        if node is not None:
            self._add_node(mapper, node)
        for number in update.edges:
            edge = moved(mapper.map.edge(number), self._known)
            self._numbers[number] = self._joint.put_edge(self._numbers.get(number), edge)
        if node is None:
            return False
        poses = mapper.poses()
        here = poses if self._pose_known_map is None else compose(self._pose_known_map, poses)
        self._joint.poses = np.concatenate([self._joint.poses[: self._known], here])
        found = [edge for edge in self._joint.meet(self._known + node) if edge.kind is EdgeKind.LOOP]
        self._sightings = [*self._sightings, *found][-NEWEST:]
        if self._sightings:
            placed = placed_by(self._sightings, self._known + node, self._joint.poses)
            self._pose_known_map = compose(placed, inverse(poses[node]))
        if found and self.found_after_m is None:
            self.found_after_m = mapper.map.node(node).travel_m
        return bool(found)

    def _add_node(self, mapper: Mapper, number: int) -> None:
        vision, node = mapper.vision, mapper.map.node(number)
        if not isinstance(vision, MeetingFrontEnd):
            raise ConfigError("known map: the mapper's front-end cannot join maps; expected a laser or an RGB-D camera")
        if number == 0:
            self._joint.begin(node)
        state, keyframe = vision.state(number), vision.keyframe(number)
        self._joint.add_node(node, mapper.map.initial[number], keyframe, state, number == 0)
