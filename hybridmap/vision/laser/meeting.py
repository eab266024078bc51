"""Where a session of a laser lies among earlier ones, and the loops between them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import Array, between
from hybridmap.graph.edges import Edge, Lack, Status
from hybridmap.vision.base import Belief, known_nodes
from hybridmap.vision.laser.commitment import Commitment
from hybridmap.vision.laser.hypotheses import LENGTH_M, Hypothesis, Prober
from hybridmap.vision.laser.kidnapping import FROM_M, OFTEN_M, SPAN_M, GlobalLocalisation
from hybridmap.vision.laser.panorama import Panoramas
from hybridmap.vision.laser.revisits import Reviser
from hybridmap.vision.laser.submap import Atlas
from hybridmap.vision.relocalising import Relocaliser, Whereabouts, placed_by

NEAREST = 2
"""A node is registered to so many old submaps, the nearest ones, where other nodes say that it is."""


class ScanMeeting:
    """Registers the last metres of a session to the submaps of earlier ones: to all until it is found, then in the gate."""

    def __init__(
        self,
        config: VisionConfig,
        atlas: Atlas,
        panoramas: Panoramas,
        prober: Prober,
        reviser: Reviser,
        localisation: GlobalLocalisation,
        new_key: Callable[[], int],
    ) -> None:
        self._every_m = config.laser.probes.every_m
        self._atlas = atlas
        self._panoramas = panoramas
        self._prober = prober
        self._reviser = reviser
        self._localisation = localisation
        self._new_key = new_key
        self._arrive(0)

    def arrive(self, first: int, *, guessed: bool = False) -> None:
        """Look for the place of the nodes from `first` on, first where they are guessed; those before it are the map."""
        self._panoramas.extend(to_the_end=True)
        self._arrive(first)
        self._guessed = guessed

    def _arrive(self, first: int) -> None:
        self._first, self._found, self._guessed = first, False, False
        self._relocaliser = Relocaliser(Whereabouts(0), self._new_key, SPAN_M)
        self._relocaliser.arrived(first)
        self._commitment = Commitment(self._atlas.travel_m.__getitem__)
        self._searched_m = float("-inf")
        self._asked: set[tuple[int, int]] = set()

    def meet(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loops of a node to the nodes before the session, every few metres; see `MeetingFrontEnd.meet`."""
        travel_m = self._atlas.travel_m[node]
        driven_m = travel_m - self._atlas.travel_m[self._first]
        often = not self._found and driven_m <= OFTEN_M
        if driven_m < FROM_M or (not often and travel_m - self._searched_m < self._every_m):
            return []
        self._searched_m = travel_m
        return self._probe(node, belief) if self._found else self._search(node, belief)

    def _search(self, node: int, belief: Belief) -> list[Edge]:
        """Register the last metres to the whole map."""
        anchors = self._prober.anchors_before(self._first)
        if not anchors:
            return []
        found = self._asked_there(node, belief, belief.poses_map_node.__getitem__) if self._guessed else []
        found += self._prober.probe_anywhere(
            self._atlas.submap(node, self._recent(node)), self._localisation.most_similar(node, anchors)
        )
        settlement = self._relocaliser.settle(self._localisation.matches(found), belief)
        proposals = settlement.proposals
        if self._relocaliser.leading:
            leading, poses = self._relocaliser.leading, belief.poses_map_node
            self._asked.update((edge.source, edge.target) for edge in leading)
            asked = self._asked_there(node, belief, lambda one: placed_by(leading, one, poses))
            settlement = self._relocaliser.settle(self._localisation.matches(asked), belief)
            proposals = proposals + settlement.proposals
        self._found = bool(settlement.accepted)
        return proposals

    def _asked_there(self, node: int, belief: Belief, placed: Callable[[int], Array]) -> list[Hypothesis]:
        """Register every node of the session up to a node where `placed` puts it, once to each old submap.

        A search of the whole map looks closely at the few places that look most alike. The first metres look like many.
        """
        poses, anchors = belief.poses_map_node, np.array(self._prober.anchors_before(self._first))
        found = []
        for asked in range(self._first, node + 1):
            expected = between(poses[anchors], placed(asked))
            nearest = np.argsort(np.hypot(expected[:, 0], expected[:, 1]), kind="stable")[:NEAREST].tolist()
            new = [i for i in nearest if (asked, int(anchors[i])) not in self._asked]
            self._asked.update((asked, int(anchors[i])) for i in new)
            if new:
                probe = self._atlas.submap(asked, self._recent(asked))
                found += [h for i in new for h in self._prober.probe_at(probe, int(anchors[i]), expected[i])]
        return found

    def _recent(self, node: int) -> NDArray[np.int64]:
        """The nodes of a probe that ends at a node."""
        recent = self._atlas.along(node, LENGTH_M, 0.0)
        return recent[recent <= node]

    def _probe(self, node: int, belief: Belief) -> list[Edge]:
        """Register the last metres to the submaps of earlier sessions that may be near."""
        self._panoramas.extend()
        out = []
        for hypothesis in self._prober.probe(node, belief, known=known_nodes(self._first, node, belief)):
            key = self._new_key()
            out.append(hypothesis.proposed(key, Lack.WAITING))
            self._commitment.add(key, hypothesis)
        return out + [s.proposed() for s in self._commitment.settle(self._atlas.travel_m[node], belief)]

    def meet_again(self, belief: Belief) -> list[Edge]:
        """Decide what is pending; if nothing is accepted, register nodes near each other; see `MeetingFrontEnd.meet_again`."""
        if not self._found:
            return self._relocaliser.dismiss()
        out = [s.proposed() for s in self._commitment.flush(belief)]
        if any(edge.status is Status.ACCEPTED for edge in out):
            return out
        known = known_nodes(self._first, len(belief.travel_m) - 1, belief)
        near = self._reviser.round(belief, self._first, known=known)
        return out + [hypothesis.proposed(self._new_key()) for hypothesis in near]
