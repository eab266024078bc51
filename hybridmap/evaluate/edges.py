"""Every edge of a map against the truth: how wrong it is, and whether its covariance says so."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.evaluate.association import MAX_GAP_S, known_at
from hybridmap.geometry import Array, between, log
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.trajectory import Trajectory

EXPECTED_MEDIAN = 2.366
"""Median of chi2 with 3 degrees of freedom."""

WRONG_M = 1.0
"""An edge farther than this from the truth is wrong, m."""


@dataclass(frozen=True, slots=True)
class EdgeErrors:
    """The accepted edges of one kind.

    Attributes:
        count: edges between nodes whose truth is known.
        trans_median_m, trans_p95_m, rot_median_deg, rot_p95_deg: their errors; NaN without any edge.
        chi2_ratio: median of the normalised squared errors over what it should be: 1 for calibrated covariances, less where
            they are too large, more where they are too small.
        wrong: edges more than a metre from the truth.
        wrong_kept: of those, the ones that a back-end gave a weight of more than a half.
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
        """Share of the edges that are wrong; NaN without any edge."""
        return self.wrong / self.count if self.count else float("nan")


def edge_errors(
    experiences: ExperienceMap, truth: Trajectory, weights: Mapping[int, float] | None = None, max_gap_s: float = MAX_GAP_S
) -> dict[EdgeKind, EdgeErrors]:
    """Judge the accepted edges of a map, kind by kind.

    Args:
        experiences: the map.
        truth: true poses of `base_link`, in any frame.
        weights: edge number -> weight that a robust back-end gave it; what is missing counts as 1.
        max_gap_s: longest gap over which the truth is interpolated.
    """
    stamps = np.array([node.stamp_ns for node in experiences.nodes], dtype=np.int64)
    known = known_at(truth, stamps, max_gap_s)
    poses = truth.at(stamps) if known.any() else np.zeros((len(stamps), 3))
    return edge_errors_on(experiences, poses, known, weights)


def edge_errors_on(
    experiences: ExperienceMap, poses: Array, known: NDArray[np.bool_] | None = None, weights: Mapping[int, float] | None = None
) -> dict[EdgeKind, EdgeErrors]:
    """The same, given the true pose (N, 3) of each node and which of them are known (default: all)."""
    known = np.ones(len(poses), dtype=np.bool_) if known is None else known
    out = {}
    for kind in (EdgeKind.ODOMETRY, EdgeKind.REGISTRATION, EdgeKind.LOOP):
        edges = {n: e for n, e in enumerate(experiences.edges) if _judged(e, kind) and known[e.source] and known[e.target]}
        if edges:
            out[kind] = _errors(edges, poses, weights or {})
    return out


def normalised_errors(edges: list[Edge], poses: Array) -> tuple[Array, Array]:
    """Errors (E, 3) of measured edges, twists in the target's frame, m and rad, and their squared Mahalanobis norms (E,)."""
    measured = [edge.relative for edge in edges if edge.relative is not None]
    ends = np.array([(e.source, e.target) for e in edges if e.relative is not None], dtype=np.int64).reshape(-1, 2)
    delta = np.array([m.delta for m in measured]).reshape(-1, 3)
    covariance = np.array([m.covariance for m in measured]).reshape(-1, 3, 3)
    error = log(between(delta, between(poses[ends[:, 0]], poses[ends[:, 1]])))
    return error, np.einsum("ei,ei->e", error, np.linalg.solve(covariance, error[..., None])[..., 0])


def _judged(edge: Edge, kind: EdgeKind) -> bool:
    return edge.kind is kind and edge.status is Status.ACCEPTED and edge.relative is not None


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
