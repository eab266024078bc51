"""Values of nodes towards a goal, made and mended by replay: reverse from the goal, forward from what is blocked.

A backup sets the value of one node. Sweeping all nodes needs many for one value to travel far, and after a blocked passage the
old values keep each other alive: each is near what its neighbours say. Here a new goal is replayed in reverse, in the order of
the values, so that each node is backed up once. When a passage is blocked, the policy is first replayed forward, from there
through all nodes whose way leads over it: their values are void. Then these alone are replayed in reverse, from their
neighbours with valid values. Both orders of replay are seen in the hippocampus: reverse at a reward, forward before a choice
(D. J. Foster, M. A. Wilson, Nature 2006; K. Diba, G. Buzsaki, Nature Neuroscience 2007); the algorithms are those of
E. W. Dijkstra (1959), and of G. Ramalingam and T. Reps, "An incremental algorithm for a generalization of the shortest-path
problem", J. Algorithms 1996.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from heapq import heapify, heappop, heappush

import numpy as np

from hybridmap.geometry import Array
from hybridmap.plan.links import Links

_NONE = -1


class ReplayPlanner:
    """Keeps the value of every node, its cost to the goal, and the node to go to next.

    Attributes:
        backups: how many values were set since the planner was made.
    """

    def __init__(self, links: Links) -> None:
        self.backups = 0
        self._links = links
        self._blocked: set[int] = set()
        self._seeds: dict[int, float] = {}
        self._values = [np.inf] * links.n_nodes
        self._next = [_NONE] * links.n_nodes

    @property
    def values(self) -> Array:
        """(N,) cost of the way from each node to the goal; infinite where there is none."""
        return np.array(self._values)

    def aim(self, seeds: Mapping[int, float]) -> int:
        """Take a new goal: reverse replay over all nodes that reach it, one backup each.

        Args:
            seeds: node -> cost from there straight to the goal; a goal that is a node has cost 0 there.

        Returns:
            The number of backups.
        """
        self._seeds = dict(seeds)
        self._values = [np.inf] * self._links.n_nodes
        self._next = [_NONE] * self._links.n_nodes
        return self._reverse([(cost, node, _NONE) for node, cost in self._seeds.items()])

    def block(self, links: Iterable[int]) -> int:
        """Take out links (by number): forward replay of what led over them, then reverse replay of that.

        Returns:
            The number of backups: one for each value that becomes void, and one for each that is found again.
        """
        self._blocked |= set(links)
        void = self._forward()
        rim = [(value, node, onward) for node in void if (best := self._best(node))[0] < np.inf for value, onward in [best]]
        return len(void) + self._reverse(rim)

    def way(self, node: int) -> list[int]:
        """The nodes from one to the last before the goal, by the policy. The node must have a value that is finite."""
        nodes = [node]
        while self._next[nodes[-1]] != _NONE:
            nodes.append(self._next[nodes[-1]])
        return nodes

    def _forward(self) -> list[int]:
        """Make void the values of all nodes whose way leads over a blocked link, and give these nodes."""
        before: list[list[int]] = [[] for _ in self._next]
        for node, onward in enumerate(self._next):
            if onward != _NONE:
                before[onward].append(node)
        heads = {tuple(self._links.ends[link].tolist()) for link in self._blocked}
        void = [a for pair in sorted(heads) for a, b in (pair, pair[::-1]) if self._next[a] == b]
        known = set(void)
        for node in void:  # grows while it is read
            self._values[node], self._next[node] = np.inf, _NONE
            self.backups += 1
            found = [other for other in before[node] if other not in known]
            void += found
            known.update(found)
        return void

    def _best(self, node: int) -> tuple[float, int]:
        """The least value of a node by its neighbours as they are, and the neighbour."""
        found = [
            (self._values[other] + cost, other) for other, cost, link in self._links.around[node] if link not in self._blocked
        ]
        return min([*found, (self._seeds.get(node, np.inf), _NONE)])

    def _reverse(self, rim: list[tuple[float, int, int]]) -> int:
        """Back up nodes in the order of their values, from (value, node, next node) on, as far as values become less."""
        heapify(rim)
        done = 0
        while rim:
            value, node, onward = heappop(rim)
            if value >= self._values[node]:
                continue
            self._values[node], self._next[node] = value, onward
            done += 1
            for other, cost, link in self._links.around[node]:
                if value + cost < self._values[other] and link not in self._blocked:
                    heappush(rim, (value + cost, other, node))
        self.backups += done
        return done
