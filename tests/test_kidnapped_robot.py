"""A robot that is carried away unseen finds itself again, by its camera or by its laser, in whole drives."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.evaluate import evaluate_session
from hybridmap.geometry import align, between, compose
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.gaps import kidnappings
from hybridmap.session import run
from hybridmap.simulation import SimulatedStream
from hybridmap.store import MapStore
from tests.narrowing import known


@pytest.mark.slow
@pytest.mark.parametrize(
    ("named", "world", "carried_m", "seed"),
    [("rgbd", "lab", 5.0, 0), ("rgbd", "office", 19.5, 0), *(("laser", "office", 19.5, seed) for seed in range(1, 6))],
)
def test_it_is_relocalised_within_five_metres(named, world, carried_m, seed, tmp_path):
    settings = {"simulation.world": world, "simulation.carried_m": 20.0, "backends.names": ["gtsam-gnc"]}
    config = Config.load(named, settings)
    stream = SimulatedStream(config.simulation, seed)
    carry = known(stream.carry)
    assert carry.distance_m > carried_m
    done = run(stream, config, tmp_path / "s")
    with MapStore.open(done.folder.path) as store:
        experiences, online, final = store.map(), store.online("gtsam-gnc"), store.solutions()["gtsam-gnc"]
    stamps = np.array([node.stamp_ns for node in experiences.nodes])
    truth = stream.groundtruth.at(stamps)
    down = int(np.searchsorted(stamps, stream.groundtruth.stamps_ns[carry.last]))
    put_down = stream.groundtruth.poses[carry.last, :2]
    travel_m = np.hypot(*np.diff(truth[down:, :2], axis=0, prepend=put_down[None]).T).cumsum()
    believed = online.at(stamps)
    on_map = compose(align(truth[:down], believed[:down]), believed)
    off_m = np.hypot(*(on_map - truth)[down:, :2].T)
    found = int(np.argmax(off_m < 0.5))
    assert off_m[0] > 0.5
    assert travel_m[found] < 5.0
    assert off_m[found:].max() < 0.5
    loops = [edge for edge in experiences.edges if edge.kind is EdgeKind.LOOP and edge.status is Status.ACCEPTED]
    back = [edge for edge in loops if edge.source >= down > edge.target]
    assert travel_m[min(edge.since_node for edge in back) - down] < 5.0
    first = min(back, key=lambda edge: edge.since_node)
    error = between(between(truth[first.source], truth[first.target]), known(first.relative).delta)
    assert np.hypot(error[0], error[1]) < 0.1
    assert (down - 1, down) in {(gap.before, gap.after) for gap in kidnappings(experiences)}
    figures = {metric.name: metric.value for metric in evaluate_session(done.folder.path)}
    assert figures["ate_max/gtsam-gnc"] < 0.2
    ends = compose(align(truth, final.poses), final.poses)
    assert np.hypot(*(ends - truth)[:, :2].T).max() < 0.2
