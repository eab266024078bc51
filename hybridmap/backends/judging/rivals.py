"""Groups of refused loops that agree with each other, and what the map has against them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.gtsam.covariance import Covariances, expected_loops
from hybridmap.backends.judging.strain import optimum
from hybridmap.backends.objective import residuals, squared_norms, unit_variance
from hybridmap.geometry import Array, apart_m
from hybridmap.graph.agreement import BOUND
from hybridmap.graph.pose_graph import PoseGraph


@dataclass(frozen=True, slots=True)
class Rival:
    """A group of refused loops that agree with each other and contradict the map.

    If the group is right, then the chain is wrong somewhere between the older and the newer ends of its loops. The step of
    the chain that most loops of the group for each loop of the map span is the one where this contradicts least.

    Attributes:
        edge_ids: the loops of the group.
        node: the step leads to this node from the one before it.
        first, last: the steps about that one, up to these nodes, that more loops of the group than of the map span.
        spanning: loops of the group that span the step.
        against: loops of the map that span it too: they say that it is right.
        shift_m, turn_rad: how far the loops of the group would move the map, median.
    """

    edge_ids: tuple[int, ...]
    node: int
    first: int
    last: int
    spanning: int
    against: int
    shift_m: float
    turn_rad: float


@dataclass(frozen=True, slots=True)
class Admitted:
    """A map with refused loops admitted to it, compared with the map without them.

    Attributes:
        shift_m: RMS distance between the two maps, over the nodes.
        error_m: RMS error that the covariances of the edges predict for the map with these loops.
        expected: share of the loops that the map without them expects, given its covariance.
    """

    shift_m: float
    error_m: float
    expected: float


def admitted(graph: PoseGraph, poses: Array, in_map: NDArray[np.bool_], loops: Sequence[int]) -> Admitted:
    """Compare a map with the one that has refused loops too.

    Where a file overstates its noise, all covariances are scaled by the unit variance of the map with the loops.

    Args:
        graph: the edges of the map, and the loops.
        poses: (N, 3) poses of the map, m and rad.
        in_map: (E,) which edges the map was made of.
        loops: edge ids of the refused loops, at least one.

    Raises:
        BackendError: the map is singular.
    """
    members = np.isin(graph.edge_ids, np.array(loops, dtype=np.int64))
    both = graph.with_edges(in_map | members)
    without = optimum(graph.with_edges(in_map), poses)
    best = optimum(both, without)
    variance = min(1.0, unit_variance(both, squared_norms(both, best)))
    among = np.flatnonzero(np.isin(both.edge_ids, graph.edge_ids[members]))
    expected = expected_loops(both, without, among, variance, BOUND)
    error_m = math.sqrt(variance) * Covariances(both, best).position_error()
    return Admitted(apart_m(best, without), error_m, float(np.mean(expected)))


def rivals(graph: PoseGraph, poses: Array, groups: Sequence[Sequence[int]], kept: NDArray[np.bool_]) -> list[Rival]:
    """What each group of refused loops claims, and how many loops of the map stand against it; one result for each group.

    Args:
        graph: the graph with the loops of the groups.
        poses: (N, 3) poses of the map, m and rad.
        groups: edge ids of the loops of each group, e.g. by `clusters.rejected_clusters`.
        kept: (E,) which edges are loops that the map keeps.
    """
    against, found = spans(graph, kept), []
    for group in groups:
        members = np.isin(graph.edge_ids, np.array(group, dtype=np.int64))
        spanning = spans(graph, members)
        node = int(np.argmax(spanning / (against + 1)))
        apart = np.abs(residuals(graph.with_edges(members), poses))
        shift_m, turn_rad = float(np.median(np.hypot(apart[:, 0], apart[:, 1]))), float(np.median(apart[:, 2]))
        first, last = _about(node, spanning > against)
        found.append(Rival(tuple(group), node, first, last, int(spanning[node]), int(against[node]), shift_m, turn_rad))
    return found


def _about(node: int, disputed: NDArray[np.bool_]) -> tuple[int, int]:
    """First and last node of the run about a node on which a mask (N,) is true; the node itself if it is false there."""
    others = np.flatnonzero(~disputed)
    after, before = others[others > node], others[others < node]
    if not disputed[node]:
        return node, node
    return int(before.max(initial=-1)) + 1, int(after.min(initial=len(disputed))) - 1


def spans(graph: PoseGraph, chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(N,) number of chosen edges that span the step of the chain to each node from the one before it."""
    ends = np.sort(np.stack([graph.sources[chosen], graph.targets[chosen]]), axis=0)
    change = np.zeros(graph.n_nodes + 1, dtype=np.int64)
    np.add.at(change, ends[0] + 1, 1)
    np.add.at(change, ends[1] + 1, -1)
    return change.cumsum()[: graph.n_nodes]
