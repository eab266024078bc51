"""When a node is due."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from hybridmap.config.mapping import EdgesConfig, NodesConfig
from hybridmap.geometry import compose, exp
from hybridmap.graph.experience_map import Novelty
from hybridmap.graph.paths import odometry_covariance

HERE, ELSEWHERE = np.array([1.0, 0.0], np.float32), np.array([0.0, 2.0], np.float32)


def test_travel_rule_names_its_reason():
    novelty = Novelty(NodesConfig(distance_m=0.5, angle_deg=20))
    assert novelty.reason(np.zeros(3), lambda: HERE, False) == "first experience"
    novelty.remember(HERE)
    assert novelty.reason(np.array([0.3, 0.3, 0.1]), lambda: ELSEWHERE, True) is None
    assert "0.51 m" in str(novelty.reason(np.array([0.4, 0.31, 0.1]), lambda: HERE, False))
    assert "23 deg" in str(novelty.reason(np.array([0.0, 0.0, -0.4]), lambda: HERE, False))


def test_novelty_rule_compares_with_every_node():
    novelty = Novelty(NodesConfig(rule="novelty", place_threshold=0.4))
    for code in (HERE, ELSEWHERE):
        novelty.remember(code)
    far = np.array([9.0, 9.0, 1.0])
    assert novelty.reason(far, lambda: 5 * HERE, False) is None
    assert novelty.reason(far, lambda: -HERE, False) is not None
    assert novelty.reason(np.zeros(3), lambda: HERE, True) == "new view template"


def test_passage_rule_asks_the_newest_node_alone():
    novelty = Novelty(NodesConfig(rule="passage", place_threshold=0.3))
    assert novelty.reason(np.zeros(3), lambda: HERE, False) == "first experience"
    for code in (HERE, ELSEWHERE):
        novelty.remember(code)
    assert novelty.reason(np.zeros(3), lambda: HERE, False) is not None  # known, but from an earlier passage
    assert novelty.reason(np.array([9.0, 9.0, 0.0]), lambda: 3 * ELSEWHERE, False) is None
    assert novelty.reason(np.zeros(3), lambda: ELSEWHERE, True) == "new view template"
    assert novelty.reason(np.zeros(3), lambda: 0.0 * ELSEWHERE, False) is not None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_passage_rule_multiplies_the_likeness_of_place_and_of_heading(sign):
    novelty = Novelty(NodesConfig(rule="passage", place_threshold=0.3))
    novelty.remember(HERE)
    near = np.array([0.9, np.sqrt(1.0 - 0.9**2)], np.float32)
    for code, cosine in ((HERE, 1.0), (near, 0.9)):
        limit = np.arccos(0.7 / cosine)
        same = functools.partial(np.copy, code)
        assert novelty.reason(np.array([0.0, 0.0, sign * (limit - 0.01)]), same, False) is None
        assert novelty.reason(np.array([0.0, 0.0, sign * (limit + 0.01)]), same, False) is not None


def test_a_jump_of_the_cells_at_a_closure_is_no_passage():
    novelty = Novelty(NodesConfig(rule="passage", place_threshold=0.3))
    novelty.remember(HERE)
    assert novelty.reason(np.zeros(3), lambda: ELSEWHERE, False) is not None
    novelty.recalibrate(ELSEWHERE)
    assert novelty.reason(np.zeros(3), lambda: ELSEWHERE, False) is None
    assert novelty.reason(np.zeros(3), lambda: HERE, False) is not None
    assert novelty.distance(HERE) == 0.0
    novelty.remember(HERE)
    assert novelty.reason(np.zeros(3), lambda: HERE, False) is None


def test_odometry_covariance_agrees_with_a_random_walk():
    config = EdgesConfig(
        translation_floor_m=1e-4, rotation_floor_deg=1e-3, translation_per_sqrt_m=0.02, rotation_deg_per_sqrt_m=2.0,
        rotation_per_turn=0.0,
    )  # fmt: skip
    rng, n, travel = np.random.default_rng(1), 200, 2.0
    end = np.zeros((4000, 3))
    for _ in range(n):
        turn = rng.normal(0, np.deg2rad(2.0) * np.sqrt(travel / n), 4000)
        end = compose(end, exp(np.stack([np.full(4000, travel / n), np.zeros(4000), turn], axis=1)))
    end = compose(np.array([-travel, 0.0, 0.0]), end)
    in_target_frame = np.stack([end[:, 0], end[:, 1] - travel * end[:, 2], end[:, 2]], axis=1)
    sampled = np.cov(in_target_frame.T)
    predicted = odometry_covariance(config, travel, 0.0)
    assert np.isclose(predicted[2, 2], sampled[2, 2], rtol=0.1)
    assert np.isclose(predicted[1, 1] - 0.02**2 * travel, sampled[1, 1], rtol=0.15)
    assert np.isclose(predicted[1, 2], sampled[1, 2], rtol=0.15)
