"""How well the scans of a laser fit, for the second opinion at the end of the drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hybridmap.graph.edges import Edge, EdgeKind, Lack
from hybridmap.vision.base import Belief
from hybridmap.vision.laser.hypotheses import LENGTH_M, Prober
from hybridmap.vision.laser.kidnapping import RECENT_M, SPAN_M, Continuity, GlobalLocalisation
from hybridmap.vision.laser.revisits import Reviser
from hybridmap.vision.laser.submap import Atlas
from hybridmap.vision.relocalising import MISMATCH_SCALE, GlobalMatch


class ScanWitness:
    """Registers the last metres of a node to the whole map; implements `vision.second_opinion.Witness`."""

    worse = 2.0 * MISMATCH_SCALE
    span_m = SPAN_M
    reach_m = 0.5 * LENGTH_M

    def __init__(
        self,
        atlas: Atlas,
        prober: Prober,
        reviser: Reviser,
        localisation: GlobalLocalisation,
        continuity: Continuity,
        new_key: Callable[[], int],
    ) -> None:
        self._atlas = atlas
        self._prober = prober
        self._reviser = reviser
        self._localisation = localisation
        self._continuity = continuity
        self.new_key = new_key

    def misfit(self, edge: Edge) -> float:
        """Share of the points that do not fit; for a loop, plus the share of walls in the other's free space."""
        seen = edge.figures if edge.kind is EdgeKind.REGISTRATION else {check.figure: check.value for check in edge.checks}
        return 1.0 - seen.get("fit", np.nan) + seen.get("violation", 0.0)

    def matches(self, node: int, since: int) -> list[GlobalMatch]:
        """Registrations of the last metres before a node, from `since` on, to old submaps that lie wholly before `since`."""
        anchors = self._prober.anchors_before(since)
        if not anchors:
            return []
        recent = self._atlas.along(node, RECENT_M, 0.0)
        probe = self._atlas.submap(node, recent[recent >= since])
        found = self._prober.probe_anywhere(probe, self._localisation.most_similar(node, anchors))
        return [GlobalMatch(h.proposed(self.new_key(), Lack.WAITING), h.misfit) for h in found if h.passed]

    def carried_to(self, matches: Sequence[Edge], since: int, belief: Belief) -> range:
        """The first node whose scan fits the scans from well before `since` better where the matches put it."""
        known = int(self._atlas.along(since, RECENT_M, 0.0)[0])
        node = self._continuity.kidnapped_unnoticed(matches, belief, known)
        return range(0) if node is None else range(node, node + 1)

    def corrected(self, edges: Sequence[Edge]) -> None:
        """Part the atlas at the carry; nodes near each other on the corrected map are registered anew."""
        for edge in edges:
            if edge.kidnapped_m is not None:
                self._atlas.part(edge.target)
                self._reviser.restart(edge.target, [(e.source, e.target) for e in edges if e.lack is Lack.KIDNAPPED])
