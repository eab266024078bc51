from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.geometry import wrap_angle
from hybridmap.vision.gating import nodes_within


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(2, 60), each=st.booleans())
def test_it_gives_the_nodes_that_are_near_and_look_the_same_way(seed, n, each):
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(-5, 5, (n, 2)), rng.uniform(-np.pi, np.pi, n)])
    node = int(rng.integers(1, n))
    radius = rng.uniform(0, 6, node) if each else 3.0
    distance = np.hypot(*(poses[:node, :2] - poses[node, :2]).T)
    expected = (distance <= radius) & (np.abs(wrap_angle(poses[:node, 2] - poses[node, 2])) <= 1.0)
    assert nodes_within(poses, node, radius, 1.0).tolist() == np.flatnonzero(expected).tolist()


def test_nodes_after_it_count_only_where_they_are_asked_for():
    poses = np.column_stack([np.arange(6.0), np.zeros(6), np.zeros(6)])
    assert nodes_within(poses, 3, 1.5, 0.1).tolist() == [2]
    assert nodes_within(poses, 3, 1.5, 0.1, before=6).tolist() == [2, 3, 4]
