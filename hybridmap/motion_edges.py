"""The edges of motion of a map, odometry and registrations, weighed by the noise of the wheels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridmap.config.mapping import EdgesConfig
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose_relative
from hybridmap.graph.edges import Edge, EdgeKind, Lack, Method, Search, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.vision.base import FrontEnd, Overruling
from hybridmap.wheel_noise import WheelNoise


class MotionEdges:
    """The odometry edges and registrations of a map, with the covariances that the noise of the wheels leaves to them.

    Attributes:
        wheels: the noise of the wheels, learnt from these edges.
    """

    def __init__(self, experiences: ExperienceMap, config: EdgesConfig) -> None:
        self._map = experiences
        self._drop_contradicted = config.drop_contradicted
        self._driven: dict[int, tuple[float, float]] = {}  # of each odometry edge
        self._measured: dict[int, Edge] = {}  # registrations as they were proposed
        self._contradicted: set[int] = set()  # odometry edges
        self._spanning: set[int] = set()  # odometry edges over stretches on which the robot was followed on older nodes
        self.wheels = WheelNoise(config)

    def join(self, source: int, target: int, delta: Array, driven: tuple[float, float], spans: bool = False) -> list[int]:
        """Add the odometry edge from the node that the robot was at to a new node, with the noise that was learnt.

        Args:
            source, target: the two nodes.
            delta: (3,) the motion between them, m and rad.
            driven: path length of the motion, m, and angle turned, rad.
            spans: whether the robot was followed on older nodes on the way: no registration is weighed against this motion.

        Returns:
            The number of the new edge, then those of edges that changed because the noise of the wheels was learnt anew.
        """
        odometry = RelativePose(delta, self.wheels.covariance(*driven))
        edge = Edge.decided(source, target, EdgeKind.ODOMETRY, odometry, method=Method.ODOMETRY, search=Search.CHAIN)
        number = self._map.add_edge(edge)
        self._driven[number] = driven
        if spans:
            self._spanning.add(number)
        changes = self.wheels.drive(*driven, delta)
        return [number, *(self._weigh_again() if changes else [])]

    def entered(self, number: int, proposal: Edge) -> list[int]:
        """Take note of a proposed edge that became edge `number`; returns the numbers of odometry edges that it drops."""
        self._measured.pop(number, None)
        if proposal.kind is EdgeKind.REGISTRATION and proposal.relative is not None and proposal.kidnapped_m is None:
            self._note(number, proposal)
        return self._contradict(proposal) if proposal.contradicts_odometry and self._drop_contradicted else []

    def retime(self, poses_odom: Array, vision: FrontEnd | Overruling | None) -> list[int]:
        """Measure the odometry of the whole chain again; where no registration contradicts it any more, it counts again.

        Args:
            poses_odom: (N, 3) new poses of all nodes in `odom`.
            vision: judges whether the registrations still contradict the odometry.

        Returns:
            The numbers of the changed edges.
        """
        self._map.move_odometry(poses_odom)
        changed: list[int] = []
        for number in self._driven:
            edge = self._map.edge(number)
            delta = between(poses_odom[edge.source], poses_odom[edge.target])
            edge = replace(edge, relative=RelativePose(delta, self.wheels.covariance(*self._driven[number])))
            if number in self._contradicted and isinstance(vision, Overruling):
                changed += self._judge_again(number, edge, vision)
            else:
                self._map.update_edge(number, edge)
        deltas = between(poses_odom[:-1], poses_odom[1:])
        changed += self._weigh_again() if self.wheels.measure_again(deltas) else []
        return sorted({*self._driven, *changed})

    def _judge_again(self, number: int, odometry: Edge, vision: Overruling) -> list[int]:
        """Write a contradicted odometry edge, measured again; it counts again if no registration contradicts it any more."""
        assert odometry.relative is not None
        against = [n for n in self._map.edges_into(odometry.target) if self._contradicts(n, odometry.source)]
        measured = [self._measured[n].relative for n in against]
        if any(one is not None and vision.overrules(one, odometry.relative) for one in measured):
            self._map.update_edge(number, odometry)
            return []
        self._contradicted.discard(number)
        back = odometry if odometry.lack is not Lack.OVERRULED else replace(odometry.settled(), since_node=-1)
        self._map.update_edge(number, back)
        for n in against:
            self._measured[n] = replace(self._measured[n], contradicts_odometry=False)
            self._map.update_edge(n, replace(self._map.edge(n), contradicts_odometry=False))
        return against

    def _contradicts(self, number: int, source: int) -> bool:
        """Whether an edge from a node is a registration that contradicts the odometry."""
        return (
            number in self._measured and self._measured[number].contradicts_odometry and self._map.edge(number).source == source
        )

    def _note(self, number: int, proposal: Edge) -> None:
        """Weigh a registration against the wheels, and let their noise be learnt from it."""
        assert proposal.relative is not None
        self._measured[number] = proposal
        if self.wheels.trusted:
            self._weigh_registration(number)
        newest = len(self._map) - 1
        if proposal.status is Status.ACCEPTED and proposal.target == newest and proposal.source == newest - 1:
            self.wheels.register(proposal.relative)

    def _weigh_again(self) -> list[int]:
        """Give all edges of motion the covariance that the noise of the wheels now says; returns the edges that changed."""
        changed = [number for number in self._driven if self._weigh_odometry(number)]
        return changed + [number for number in self._measured if self._weigh_registration(number)]

    def _weigh_odometry(self, number: int) -> bool:
        edge = self._map.edge(number)
        assert edge.relative is not None
        covariance = self.wheels.covariance(*self._driven[number])
        weighed = replace(edge, relative=RelativePose(edge.relative.delta, covariance))
        lack = None if self.wheels.trusted else Lack.OVERRULED
        if number in self._contradicted and edge.lack in (None, Lack.OVERRULED) and edge.lack is not lack:
            weighed = replace(weighed.settled(lack=lack), since_node=-1)
        return self._write(number, weighed)

    def _weigh_registration(self, number: int) -> bool:
        proposal = self._measured[number]
        assert proposal.relative is not None
        wheels = RelativePose(IDENTITY, np.zeros((3, 3)))
        for node in range(proposal.source + 1, proposal.target + 1):
            number_of_step = self._own_odometry(node)
            if number_of_step is None:
                return False
            step = self._map.edge(number_of_step).relative
            assert step is not None
            wheels = compose_relative(wheels, RelativePose(step.delta, self.wheels.covariance(*self._driven[number_of_step])))
        relative = self.wheels.beside(proposal.relative, wheels)
        return self._write(number, replace(self._map.edge(number), relative=relative))

    def _write(self, number: int, edge: Edge) -> bool:
        """Replace an edge if its covariance or status differs; returns whether it did."""
        before = self._map.edge(number)
        assert before.relative is not None
        assert edge.relative is not None
        if edge.status is before.status and np.array_equal(edge.relative.covariance, before.relative.covariance):
            return False
        self._map.update_edge(number, edge)
        return True

    def _own_odometry(self, node: int) -> int | None:
        """Number of the odometry edge from the node before to a node; None if there is none."""
        own = (n for n in self._map.edges_into(node) if n in self._driven and n not in self._spanning)
        return next((n for n in own if self._map.edge(n).source == node - 1), None)

    def _contradict(self, proposal: Edge) -> list[int]:
        """Drop the odometry edges that an edge contradicts; where the wheels are trusted, only a kidnapped robot's."""
        ends = {proposal.source, proposal.target}
        dropped = []
        for number in self._map.edges_into(max(ends)):
            edge = self._map.edge(number)
            if edge.kind is not EdgeKind.ODOMETRY or edge.source not in ends:
                continue
            if proposal.kidnapped_m is None:
                self._contradicted.add(number)
            else:
                self._contradicted.discard(number)
            if proposal.kidnapped_m is not None or not self.wheels.trusted:
                self._map.update_edge(number, replace(edge.settled(lack=Lack.OVERRULED), since_node=-1))
                dropped.append(number)
        return dropped
