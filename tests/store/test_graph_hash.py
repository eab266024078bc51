from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridmap.geometry import RelativePose
from hybridmap.graph.edges import Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.io import graph_hash
from tests.narrowing import known
from tests.store.sessions import ring_map

LOOP = 40


def test_hash_is_of_the_graph_and_of_nothing_else():
    one, other = ring_map(), ring_map()
    assert graph_hash(one) == graph_hash(other)
    assert len(graph_hash(one)) == 64
    other.update_edge(LOOP, replace(other.edge(LOOP), checks=(), figures={"x": 1.0}))
    assert graph_hash(one) == graph_hash(other)


def test_any_change_of_the_graph_changes_it():
    whole = ring_map()
    assert whole.edge(LOOP).status is Status.ACCEPTED
    relative = known(whole.edge(LOOP).relative)
    nudged = np.nextafter(relative.delta, 10)
    wider = relative.covariance * (1 + 1e-12)
    hashes = {graph_hash(whole), graph_hash(ring_map(loops=False)), graph_hash(ring_map(laps=1.4)), graph_hash(ExperienceMap())}
    for changed in (
        {"relative": RelativePose(nudged, relative.covariance)},
        {"relative": RelativePose(relative.delta, wider)},
        {"status": Status.REJECTED},
        {"kind": type(whole.edge(LOOP).kind).MANUAL},
    ):
        other = ring_map()
        other.update_edge(LOOP, replace(other.edge(LOOP), **changed))
        hashes.add(graph_hash(other))
    moved = ExperienceMap()
    for number, node in enumerate(whole.nodes):
        moved.add_node(replace(node, stamp_ns=node.stamp_ns + 1) if number == 7 else node, whole.initial[number])
    for edge in whole.edges:
        moved.add_edge(edge)
    hashes.add(graph_hash(moved))
    assert len(hashes) == 9


def test_negative_zero_is_zero():
    maps = []
    for zero in (0.0, -0.0):
        single = ExperienceMap()
        single.add_node(ring_map().node(0), np.array([zero, 0.0, 0.0]))
        maps.append(graph_hash(single))
    assert maps[0] == maps[1]
