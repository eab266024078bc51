from __future__ import annotations

import numpy as np
import pytest

from hybridmap.evaluate import closure_errors
from hybridmap.evaluate.edge_errors import ClosureLimits
from hybridmap.trajectory import Trajectory
from tests.store.sessions import SECOND, ring_map, truth_at


@pytest.fixture
def truth() -> Trajectory:
    stamps = np.arange(0, 90 * SECOND, SECOND // 10)
    return Trajectory(stamps, truth_at(stamps))


def test_right_loops_are_right_and_found(truth):
    errors = closure_errors(ring_map(), truth)
    assert (errors.judged, errors.right) == (20, 20)
    assert errors.precision == 1.0
    assert errors.recall == 1.0
    # 1 m on a circle of 2 m radius is 29 deg: the lap closes 3 nodes (0.94 m, 27 deg) before it is full
    assert errors.revisits == 23
    assert errors.trans_median_m == pytest.approx(0.01, abs=1e-6)
    assert errors.rot_p95_deg == pytest.approx(0, abs=1e-6)


def test_a_false_loop_costs_precision_until_it_is_rejected(truth):
    experiences = ring_map(false_loop=True)
    false = len(experiences.edges) - 1
    assert closure_errors(experiences, truth).precision == pytest.approx(20 / 21)
    kept = closure_errors(experiences, truth, rejected={false})
    assert kept.precision == 1.0
    assert kept.judged == 20


def test_missed_revisits_cost_recall(truth):
    experiences = ring_map()
    loops = [number for number, edge in enumerate(experiences.edges) if edge.kind == 2 and edge.relative is not None]
    errors = closure_errors(experiences, truth, rejected=set(loops[1:]))
    # the one edge left is of node 40, it serves 37..43 of the revisits 37..59
    assert errors.judged == 1
    assert errors.found == 7
    assert errors.recall == pytest.approx(7 / 23)
    assert closure_errors(ring_map(loops=False), truth).recall == 0.0
    assert np.isnan(closure_errors(ring_map(loops=False), truth).precision)


def test_limits_decide(truth):
    strict = closure_errors(ring_map(), truth, limits=ClosureLimits(right_m=0.005))
    assert strict.precision == 0.0
    assert np.isnan(strict.trans_median_m)
    late = closure_errors(ring_map(), truth, limits=ClosureLimits(revisit_gap_s=1000))
    assert late.revisits == 0
    assert np.isnan(late.recall)


def test_edges_without_known_truth_are_not_judged(truth):
    part = Trajectory(truth.stamps_ns[:450], truth.poses[:450])
    assert closure_errors(ring_map(), part).judged == 5
