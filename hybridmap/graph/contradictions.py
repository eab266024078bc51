"""How far the registration of each step is from the odometry, and from which distance on that is odd."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hybridmap.geometry import RelativePose, between, log, squared_distance
from hybridmap.graph.edges import Edge, EdgeKind

ODD, ODD_FACTOR = 98.0, 1.5
"""A registration differs oddly from the odometry beyond this percentile of the drive's own steps times this factor."""


@dataclass(frozen=True, slots=True)
class Contradictions:
    """How registrations and odometry of the same steps differ.

    Attributes:
        sigmas: node -> how its registration to the node before differs from the odometry, standard deviations of the latter.
        odd: the value beyond which a step differs oddly; 0 if there are no steps.
    """

    sigmas: Mapping[int, float]
    odd: float

    def oddest(self, first: int, last: int) -> int | None:
        """The node, from `first` to `last`, whose step differs most; None if none of them differs oddly."""
        odd = [(sigma, node) for node, sigma in self.sigmas.items() if first <= node <= last and sigma > self.odd]
        return max(odd)[1] if odd else None


def contradictions(edges: Sequence[Edge]) -> Contradictions:
    """Compare each step that was registered with its odometry, whatever the status of these edges; not across a kidnapping."""
    odometry: dict[int, RelativePose] = {}
    sigmas: dict[int, float] = {}
    for edge in edges:
        if edge.relative is None or edge.source != edge.target - 1 or edge.spans_kidnapping:
            continue
        if edge.kind is EdgeKind.ODOMETRY:
            odometry[edge.target] = edge.relative
        elif edge.kind is EdgeKind.REGISTRATION and edge.target in odometry:
            wheels = odometry[edge.target]
            error = log(between(wheels.delta, edge.relative.delta))
            sigmas[edge.target] = float(np.sqrt(squared_distance(error, wheels.covariance)))
    return Contradictions(sigmas, ODD_FACTOR * float(np.percentile(list(sigmas.values()), ODD)) if sigmas else 0.0)
