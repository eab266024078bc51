"""A laser robot that was carried away is looked for on the whole map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hybridmap.config.vision import VisionConfig
from hybridmap.graph.edges import Check, Edge, Lack
from hybridmap.vision.base import Belief
from hybridmap.vision.gating import Chain, Whereabouts
from hybridmap.vision.laser.continuity import RECENT_M, Continuity
from hybridmap.vision.laser.hypotheses import LENGTH_M, Hypothesis, Prober
from hybridmap.vision.laser.submap import Atlas
from hybridmap.vision.profile import Profile
from hybridmap.vision.relocalising import Relocaliser, Settlement, Sighting
from hybridmap.vision.templates import Matcher

UNRECOGNISED_PROBES = 2
"""Probes that recognise nothing while the map contradicts what is seen, with none that does between them, after which the
robot is lost too."""
SPAN_M = 1.5
"""Travel that sightings must cover, m: submaps that overlap less than they say something new."""
FROM_M, OFTEN_M = 0.9, 6.0
"""Travel since the break from which on the scans since then are held against the whole map, and up to which that is done at
each node, m; then as often as loops are looked for."""
SUBMAPS = 100
"""Old submaps that are searched, at most; where there are more, those whose views are likest."""
MISFIT = 0.015
"""Where the scans of the drive fit one another better than so (the share that does not), a sighting that fits as badly as
elsewhere is a worse one: its mismatch counts for more, in proportion."""
MISFIT_STEPS = 10
"""Steps for which the usual misfit of scans is taken before any was seen."""
ALIKE = (0.5, 0.5)
"""Weights of intensity and depth where views are ranked: a laser's profile has the one band, and they do not matter."""


class WholeMap:
    """Whether a laser robot is lost, and the search for it. The newer node is the source of an edge.

    Where the chain breaks a new piece of the atlas begins. Its scans are held against all submaps of before, and what fits
    is a sighting, until enough of them agree (`Relocaliser`).
    """

    def __init__(
        self,
        config: VisionConfig,
        atlas: Atlas,
        prober: Prober,
        continuity: Continuity,
        profiles: Sequence[Profile],
        new_key: Callable[[], int],
    ) -> None:
        self._every_m = config.laser.probes.every_m
        self._atlas = atlas
        self._prober = prober
        self._profiles = profiles
        self._new_key = new_key
        self._continuity = continuity
        self._whereabouts = Whereabouts(UNRECOGNISED_PROBES if config.relocalising.enabled else 0)
        self._relocaliser = Relocaliser(self._whereabouts, new_key, SPAN_M)
        self._views = Matcher("plain", *ALIKE, max_shift=config.profile.max_shift)
        self._misfits, self._steps = MISFIT_STEPS * MISFIT, MISFIT_STEPS
        self._broken_at: int | None = None
        self._lost_m, self._searched_m = 0.0, -np.inf

    @property
    def lost_since(self) -> int | None:
        """The node at which the chain broke, while the robot is not found."""
        return self._broken_at

    @property
    def since(self) -> int:
        """The first node of the piece of map that the robot surely is on: 0, or where the chain broke."""
        return self._broken_at or 0

    def tracked(self, registration: Edge, broken_by: tuple[Check, ...]) -> Edge:
        """Take notice of how the newest node of the atlas was registered; a new piece begins with it if the chain broke.

        Args:
            registration: of the newest node to those before it.
            broken_by: the checks that say that the robot did not drive there; empty where the chain holds.

        Returns:
            The registration with these checks.
        """
        node = registration.target
        if broken_by:
            self._atlas.part(node)
            self._broken_at = node
            self._lost_m, self._searched_m = self._atlas.travel_m[node], -np.inf
            registration = replace(registration, broken_by=broken_by)
        else:
            self._misfits, self._steps = self._misfits + 1.0 - registration.figures["fit"], self._steps + 1
        self._relocaliser.tracked(node, Chain.BROKEN if broken_by else Chain.HOLDS, [registration])
        return registration

    def probed(self, node: int, hypotheses: Sequence[Hypothesis], belief: Belief) -> None:
        """Keep account of whether the robot recognises what it should, by what a probe inside the gate found.

        A bare corridor fits, if anywhere along itself: that says neither.
        """
        if self._broken_at is not None:
            return
        if any(h.passed for h in hypotheses):
            self._whereabouts.recognised()
        elif any(h.fits for h in hypotheses):
            return
        elif self._continuity.contradicted(node, belief):
            if not self._whereabouts.lost:
                self._lost_m = self._atlas.travel_m[node] - FROM_M
            self._whereabouts.unrecognised()

    def closed(self) -> list[Edge]:
        """Loops inside the gate have entered the map: the robot is where the map has it, if it is on that piece of it."""
        if self._broken_at is not None:
            return []
        self._whereabouts.recognised()
        return self._relocaliser.dismiss(Lack.NOT_LOST)

    def finish(self) -> list[Edge]:
        """The drive is over: sightings that still wait are refused."""
        return self._relocaliser.dismiss()

    def search(self, node: int, belief: Belief) -> Settlement:
        """While the robot is lost, hold its last metres against the whole map; now and then, once that has been in vain."""
        if not self._whereabouts.lost or not self._due(node):
            return Settlement([])
        self._searched_m = self._atlas.travel_m[node]
        broken = self._broken_at is not None
        recent = self._atlas.along(node, LENGTH_M if broken else RECENT_M, 0.0)
        anchors = self._prober.anchors_before(self.since if broken else int(recent[0]))
        found = self._prober.probe_anywhere(self._atlas.submap(node, recent), self.likeliest(node, anchors))
        settlement = self._relocaliser.settle([self._sighting(h) for h in found], belief)
        return self._found(settlement, belief) if settlement.friends else settlement

    def _due(self, node: int) -> bool:
        """Whether the whole map is to be searched: at each node soon after it got lost, then as often as it is probed."""
        travel_m = self._atlas.travel_m[node]
        if travel_m - self._lost_m <= OFTEN_M:
            return travel_m - self._lost_m >= FROM_M
        return travel_m - self._searched_m >= self._every_m

    def likeliest(self, node: int, anchors: list[int]) -> list[int]:
        """All anchors if they are few; else those about the nodes whose views are most like the robot's."""
        most = SUBMAPS
        if len(anchors) <= most:
            return anchors
        for profile in self._profiles[len(self._views.store) :]:
            self._views.add(profile)
        stop = anchors[-1] + 1
        ranked = self._views.best(self._profiles[node], stop, np.arange(stop)).indices
        following = np.searchsorted(np.array(anchors), ranked)
        likeliest = list(dict.fromkeys(following.tolist()))[:most]
        return [anchors[i] for i in sorted(likeliest)]

    def _sighting(self, h: Hypothesis) -> Sighting:
        """What fits is a sighting; it fits the worse, the better the scans of this drive fit one another."""
        edge = h.proposed(self._new_key(), Lack.WAITING)
        if not h.passed:
            return Sighting(edge)
        mismatch = max(1.0, MISFIT / (self._misfits / self._steps)) * h.misfit
        return Sighting(replace(edge, figures={**h.figures, "mismatch": mismatch}), mismatch)

    def _found(self, settlement: Settlement, belief: Belief) -> Settlement:
        """The robot knows where it is; where nothing had shown when it was carried, find that out."""
        broken_at, self._broken_at = self._broken_at, None
        if broken_at is not None:
            if settlement.carried_to is None:
                self._atlas.join(broken_at)
            return settlement
        carried_to = self._continuity.carried_unnoticed(settlement.friends, belief)
        if carried_to is None:
            return settlement
        self._atlas.part(carried_to)
        rehung = self._relocaliser.rehang(carried_to, settlement.friends, belief)
        return Settlement(settlement.proposals + rehung, settlement.friends, carried_to)
