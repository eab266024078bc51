"""The edges of a map against ground truth: precision and recall of loops, errors by kind of edge, and whether the edges'
covariances are as large as their errors.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, between, log, squared_distance, wrap_angle
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.trajectory import NS_PER_S, Trajectory, known_at


@dataclass(frozen=True, slots=True)
class ClosureLimits:
    """When a loop edge is correct, and what counts as a revisit.

    Attributes:
        right_m, right_deg: a loop edge is correct if its measured relative pose is this close to the truth in both.
        revisit_m, revisit_deg: largest distance and turn between a revisit and the older node that it revisits.
        revisit_gap_s: least time between the two.
        window_nodes: a revisit counts as found if the newer end of a correct loop edge is at most this many nodes from it.
    """

    right_m: float = 1.0
    right_deg: float = 15.0
    revisit_m: float = 1.0
    revisit_deg: float = 30.0
    revisit_gap_s: float = 10.0
    window_nodes: int = 3


@dataclass(frozen=True, slots=True)
class ClosureErrors:
    """Quality of a set of loop edges. Only edges between nodes whose true poses are known are evaluated.

    Attributes:
        precision: share of the evaluated edges that are correct; NaN if no edge is evaluated.
        recall: share of the revisits that a correct edge found; NaN without any revisit.
        judged, right: number of evaluated edges, and of the correct ones among them.
        revisits, found: number of revisits (nodes at a place visited before), and of those that a correct edge found.
        trans_median_m, trans_p95_m, rot_median_deg, rot_p95_deg: median and 95th percentile of the errors of the correct
            edges; NaN without any.
    """

    precision: float
    recall: float
    judged: int
    right: int
    revisits: int
    found: int
    trans_median_m: float
    trans_p95_m: float
    rot_median_deg: float
    rot_p95_deg: float


DEFAULT_LIMITS = ClosureLimits()


def closure_errors(
    experiences: ExperienceMap,
    truth: Trajectory,
    rejected: Collection[int] = (),
    limits: ClosureLimits = DEFAULT_LIMITS,
) -> ClosureErrors:
    """Evaluate the accepted loop edges of a map; edges between nodes without a known true pose are left out.

    Args:
        experiences: the map.
        truth: true poses of `base_link`, in any frame.
        rejected: numbers of loop edges that a back-end rejected; they do not count as closures.
        limits: when an edge is correct, and when a node is a revisit.
    """
    stamps, poses, known = _true_nodes(experiences, truth)
    edges = [e for n, e in _judged(experiences, EdgeKind.LOOP, known).items() if n not in rejected]
    translation, rotation = _edge_errors(edges, poses)
    right = (translation <= limits.right_m) & (rotation <= limits.right_deg)
    newer = np.array([max(edge.source, edge.target) for edge in edges], dtype=np.int64)[right]
    revisits = _revisits(stamps, poses, known, limits)
    found = _near_any(revisits, newer, limits.window_nodes)
    return ClosureErrors(
        precision=float(right.mean()) if len(edges) else float("nan"),
        recall=float(found.mean()) if len(revisits) else float("nan"),
        judged=len(edges),
        right=int(right.sum()),
        revisits=len(revisits),
        found=int(found.sum()),
        trans_median_m=_quantile(translation[right], 0.5),
        trans_p95_m=_quantile(translation[right], 0.95),
        rot_median_deg=_quantile(rotation[right], 0.5),
        rot_p95_deg=_quantile(rotation[right], 0.95),
    )


def _edge_errors(edges: list[Edge], poses: Array) -> tuple[Array, Array]:
    measured = np.array([e.relative.delta for e in edges if e.relative is not None], dtype=np.float64).reshape(-1, 3)
    ends = np.array([(edge.source, edge.target) for edge in edges], dtype=np.int64).reshape(-1, 2)
    error = between(between(poses[ends[:, 0]], poses[ends[:, 1]]), measured)
    return np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))


def _revisits(stamps: NDArray[np.int64], poses: Array, known: NDArray[np.bool_], limits: ClosureLimits) -> NDArray[np.int64]:
    """Nodes at a visited place with a similar heading."""
    found = []
    for node in np.flatnonzero(known):
        older = known & (stamps < stamps[node] - limits.revisit_gap_s * NS_PER_S)
        offset = poses[older] - poses[node]
        near = np.hypot(offset[:, 0], offset[:, 1]) <= limits.revisit_m
        if np.any(near & (np.degrees(np.abs(wrap_angle(offset[:, 2]))) <= limits.revisit_deg)):
            found.append(node)
    return np.array(found, dtype=np.int64)


def _near_any(nodes: NDArray[np.int64], targets: NDArray[np.int64], window: int) -> NDArray[np.bool_]:
    """Which nodes have a target within `window` node numbers."""
    if len(targets) == 0:
        return np.zeros(len(nodes), dtype=np.bool_)
    return np.asarray(np.abs(nodes[:, None] - np.unique(targets)[None, :]).min(axis=1, initial=window + 1) <= window)


def _quantile(values: Array, q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")


EXPECTED_MEDIAN = 2.366
"""Median of chi2 with 3 degrees of freedom."""

WRONG_M = 1.0
"""An edge farther than this from the truth is wrong, m."""


@dataclass(frozen=True, slots=True)
class EdgeErrors:
    """Errors of the accepted edges of one kind (odometry, registration or loop).

    Attributes:
        count: number of edges between nodes whose true poses are known.
        trans_median_m, trans_p95_m, rot_median_deg, rot_p95_deg: median and 95th percentile of their errors; NaN without any.
        chi2_ratio: median squared Mahalanobis error over its expected value: 1 for correct covariances, less if they are too
            large, more if they are too small.
        wrong: number of edges with an error of more than a metre.
        wrong_kept: number of those whose weight in the back-end is above one half.
    """

    count: int
    trans_median_m: float
    trans_p95_m: float
    rot_median_deg: float
    rot_p95_deg: float
    chi2_ratio: float
    wrong: int
    wrong_kept: int

    @property
    def wrong_share(self) -> float:
        """Share of the edges with an error of more than a metre; NaN without any edge."""
        return self.wrong / self.count if self.count else float("nan")


def edge_errors(
    experiences: ExperienceMap, truth: Trajectory, weights: Mapping[int, float] | None = None
) -> dict[EdgeKind, EdgeErrors]:
    """Evaluate the accepted edges of a map: kind of edge -> errors; a kind without an edge that can be evaluated is left out.

    The edge that leads across a kidnapping is a registration, and counts as one.

    Args:
        experiences: the map.
        truth: true poses of `base_link`, in any frame.
        weights: edge number -> weight in a robust back-end; a missing edge counts as 1.
    """
    _, poses, known = _true_nodes(experiences, truth)
    return edge_errors_on(experiences, poses, known, weights)


def edge_errors_on(
    experiences: ExperienceMap, poses: Array, known: NDArray[np.bool_] | None = None, weights: Mapping[int, float] | None = None
) -> dict[EdgeKind, EdgeErrors]:
    """Evaluate the accepted edges of a map, given the true poses of its nodes: kind of edge -> errors.

    As with `edge_errors`, a kind without an edge that can be evaluated is left out, and the edge that leads across a kidnapping
    counts as a registration.

    Args:
        experiences: the map.
        poses: (N, 3) true pose of each node, m and rad, in any frame.
        known: (N,) which of them are known; default: all.
        weights: edge number -> weight in a robust back-end; a missing edge counts as 1.
    """
    known = np.ones(len(poses), dtype=np.bool_) if known is None else known
    out = {}
    for kind in (EdgeKind.ODOMETRY, EdgeKind.REGISTRATION, EdgeKind.LOOP):
        if edges := _judged(experiences, kind, known):
            out[kind] = _errors(edges, poses, weights or {})
    return out


def normalised_errors(edges: list[Edge], poses: Array) -> tuple[Array, Array]:
    """Errors of E edges against the true poses (N, 3) of the nodes, in any frame, m and rad.

    Edges without a measurement are left out, so that there may be fewer rows than edges.

    Returns:
        (E, 3) the true pose of each edge's target seen from the measured one, as twists, m and rad, and their squared
        Mahalanobis norms (E,) by the covariances of the edges.
    """
    measured = [edge.relative for edge in edges if edge.relative is not None]
    ends = np.array([(e.source, e.target) for e in edges if e.relative is not None], dtype=np.int64).reshape(-1, 2)
    delta = np.array([m.delta for m in measured]).reshape(-1, 3)
    covariance = np.array([m.covariance for m in measured]).reshape(-1, 3, 3)
    error = log(between(delta, between(poses[ends[:, 0]], poses[ends[:, 1]])))
    return error, squared_distance(error, covariance)


def _true_nodes(experiences: ExperienceMap, truth: Trajectory) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Stamps (N,) of the nodes, their true poses (N, 3), and which of these are known."""
    stamps = np.array([node.stamp_ns for node in experiences.nodes], dtype=np.int64)
    known = known_at(truth, stamps)
    return stamps, truth.at(stamps) if known.any() else np.zeros((len(stamps), 3)), known


def _judged(experiences: ExperienceMap, kind: EdgeKind, known: NDArray[np.bool_]) -> dict[int, Edge]:
    """Number -> accepted edge of a kind between nodes whose truth is known."""
    return {
        number: edge
        for number, edge in enumerate(experiences.edges)
        if edge.kind is kind
        and edge.status is Status.ACCEPTED
        and edge.relative is not None
        and known[edge.source]
        and known[edge.target]
    }


def _errors(edges: Mapping[int, Edge], poses: Array, weights: Mapping[int, float]) -> EdgeErrors:
    error, squared = normalised_errors(list(edges.values()), poses)
    translation, rotation = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))
    wrong = [number for number, off in zip(edges, translation, strict=True) if off > WRONG_M]
    return EdgeErrors(
        count=len(edges),
        trans_median_m=float(np.median(translation)),
        trans_p95_m=float(np.quantile(translation, 0.95)),
        rot_median_deg=float(np.median(rotation)),
        rot_p95_deg=float(np.quantile(rotation, 0.95)),
        chi2_ratio=float(np.median(squared)) / EXPECTED_MEDIAN,
        wrong=len(wrong),
        wrong_kept=sum(weights.get(number, 1.0) > 0.5 for number in wrong),
    )
