from __future__ import annotations

import numpy as np
import pytest

from hybridmap.evaluate.edge_errors import edge_errors
from hybridmap.geometry import IDENTITY, RelativePose, between, compose, exp
from hybridmap.graph.edges import Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.trajectory import Trajectory
from tests.store.sessions import SECOND, truth_at

COVARIANCE = np.array([[4e-4, 1e-4, 0.0], [1e-4, 1e-4, -2e-5], [0.0, -2e-5, 1e-4]])


def noisy_map(scale: float, loops: int = 1500) -> tuple[ExperienceMap, Trajectory]:
    """Loop edges with noise of a known covariance, stated `scale` times as large."""
    rng = np.random.default_rng(3)
    stamps = np.arange(60) * SECOND
    truth = truth_at(stamps)
    experiences = ExperienceMap()
    for k in range(60):
        experiences.add_node(Node(int(stamps[k]), IDENTITY, np.zeros(1, np.float32), -1, 0.0), IDENTITY)
    ends = rng.integers(0, 60, (loops, 2))
    for (i, j), noise in zip(ends, rng.multivariate_normal(np.zeros(3), COVARIANCE, loops), strict=True):
        if i != j:
            relative = RelativePose(compose(between(truth[i], truth[j]), exp(noise)), scale * COVARIANCE)
            experiences.add_edge(Edge(int(i), int(j), EdgeKind.LOOP, Status.ACCEPTED, relative))
    return experiences, Trajectory(stamps, truth)


@pytest.mark.parametrize("scale", [1.0, 4.0, 0.25])
def test_the_ratio_is_one_for_calibrated_covariances_and_says_how_far_others_are_off(scale):
    errors = edge_errors(*noisy_map(scale))[EdgeKind.LOOP]
    assert errors.chi2_ratio == pytest.approx(1.0 / scale, rel=0.1)
    assert errors.wrong == 0


def test_wrong_edges_are_counted_and_those_that_were_kept():
    experiences, truth = noisy_map(1.0, loops=20)
    number = experiences.add_edge(Edge(3, 40, EdgeKind.LOOP, Status.ACCEPTED, RelativePose(np.array([9.0, 0, 0]), COVARIANCE)))
    refused = Edge(3, 41, EdgeKind.LOOP, Status.REJECTED, RelativePose(np.array([9.0, 0, 0]), COVARIANCE))
    experiences.add_edge(refused)
    kept = edge_errors(experiences, truth)[EdgeKind.LOOP]
    assert (kept.wrong, kept.wrong_kept) == (1, 1)
    assert kept.wrong_share == pytest.approx(1 / kept.count)
    assert edge_errors(experiences, truth, {number: 0.4})[EdgeKind.LOOP].wrong_kept == 0


def test_edges_at_unknown_times_are_left_out():
    experiences, truth = noisy_map(1.0, loops=50)
    part = Trajectory(truth.stamps_ns[:30], truth.poses[:30])
    inside = sum(max(e.source, e.target) < 30 for e in experiences.edges)
    assert edge_errors(experiences, part)[EdgeKind.LOOP].count == inside
    assert EdgeKind.REGISTRATION not in edge_errors(experiences, truth)
