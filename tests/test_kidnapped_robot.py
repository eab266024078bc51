"""A robot that is carried away unseen finds itself again, by its camera or by its laser, in whole drives."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.evaluate import evaluate_session
from hybridmap.geometry import align, between, compose
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.gaps import kidnappings
from hybridmap.mapper import Mapper
from hybridmap.neural.vector import GridVectors
from hybridmap.session import run
from hybridmap.simulation import SimulatedStream
from hybridmap.store import MapStore
from tests.narrowing import known

CARRIED = {
    "simulation.world": "lab", "simulation.carried_m": 4.0, "backends.names": ["gtsam-isam2"], "neural.reanchor_weight": 1.0,
}  # fmt: skip


def test_the_map_file_has_the_codes_that_were_put_back(tmp_path):
    """The vectors of the grid code lead from nodes before the kidnapping to those made while the robot was lost."""
    config = Config.load("laser", CARRIED)
    stream = SimulatedStream(config.simulation, 1)
    done = run(stream, config, tmp_path / "s")
    with MapStore.open(done.folder.path) as store:
        phases, nodes = store.grid_phases(), store.map().nodes
    stamps = np.array([node.stamp_ns for node in nodes])
    truth = stream.groundtruth.at(stamps)
    down = int(np.searchsorted(stamps, stream.groundtruth.stamps_ns[known(stream.carry).last]))
    vectors = GridVectors(config.neural)
    for node in range(down, down + 5):
        vector = vectors.between(phases[0], phases[node])
        true_m = between(truth[0], truth[node])[:2]  # the cells start at the first node, along the robot
        assert vector.agreed
        assert np.hypot(*(vector.displacement_m - true_m)) < 0.5


def test_its_cells_take_up_the_code_of_the_place_that_is_recognised():
    """The network goes on from there, and so do the codes of the nodes that were made while the robot was lost."""
    config = Config.load("laser", CARRIED)
    stream = SimulatedStream(config.simulation, 1)
    mapper, carry = Mapper(config, stream.rig), known(stream.carry)
    down_ns, lost, found_ns = int(stream.groundtruth.stamps_ns[carry.last]), -1, np.inf
    for sample in stream:
        for update in mapper.add(sample):
            was_lost = lost >= 0 and mapper.lost_since is None
            found_ns = min(found_ns, update.stamp_ns) if was_lost else found_ns
            lost = known(mapper.lost_since) if lost < 0 and mapper.lost_since is not None else lost
            if was_lost and update.stamp_ns == found_ns:
                shown, odom = mapper.integrator.pose, update.pose_odom_robot
        if sample.stamp_ns > found_ns + 3 * 10**9:
            break
    stamps = np.array([node.stamp_ns for node in mapper.map.nodes])
    truth, cells = stream.groundtruth.at(stamps), mapper.cells.poses_of_nodes
    assert stamps[lost - 1] < down_ns <= stamps[lost + 1]
    found = int(np.searchsorted(stamps, found_ns))
    assert found > lost + 4
    off = between(between(truth[0], truth), between(cells[0], cells))
    off_m = np.hypot(off[:, 0], off[:, 1])
    assert off_m[lost:].max() < off_m[:lost].max() + 0.1 < 0.5  # no farther than it ever was: the drift of the wheels
    near = int(np.argmin(np.hypot(*(truth[:lost] - truth[found])[:, :2].T)))
    seen = between(between(truth[near], truth[found]), between(cells[near], cells[found]))
    assert np.hypot(seen[0], seen[1]) < 0.1
    assert mapper.cells.put_back_nodes == list(range(lost, found + 1))
    goes_on = between(between(odom, mapper.cells.pose_odom_robot), between(shown, mapper.integrator.pose))
    assert goes_on == pytest.approx(np.zeros(3), abs=1e-3)


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
