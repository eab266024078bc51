"""Single scans tell on which side of a carry they were taken, and scans between nodes on which side of a jump."""

import numpy as np
import pytest

from hybridmap.geometry import between, compose
from hybridmap.streams.laser import LaserScan
from hybridmap.vision.laser.cloud import cloud_of_scan
from hybridmap.vision.laser.dense_trajectory import DenseTrajectory, ObservedScan
from hybridmap.vision.laser.division import divide
from hybridmap.vision.laser.submap import Atlas
from tests.narrowing import known
from tests.vision.laser.laser_worlds import LASER, cast, ring, ring_drive

CARRIED, AT = 10, 120
"""Steps of 0.1 m over which the robot is carried, and the first node after that."""
EVERY = 5


def atlas_of(nodes, chain):
    """The scans of nodes at true poses (N, 3), with a chain (N, 3) of scan matching."""
    rng, atlas = np.random.default_rng(3), Atlas()
    for pose, felt in zip(nodes, chain, strict=True):
        ranges = cast(ring(), pose, rng)
        atlas.scene.observe(ranges)
        atlas.add(cloud_of_scan(ranges, LASER, atlas.scene.scale), ranges, felt, np.zeros((3, 3)))
    return atlas


@pytest.fixture(scope="module")
def carried():
    """An atlas whose chain is broken before node AT, and the true poses of its nodes."""
    way = ring_drive(2.0)
    truth = np.concatenate([way[: AT * EVERY : EVERY], way[AT * EVERY + CARRIED :: EVERY]])
    felt = compose(way[AT * EVERY], between(truth[AT], truth[AT:]))
    return atlas_of(truth, np.concatenate([truth[:AT], felt])), truth


def loosened(atlas, truth, place):
    """Poses of the nodes on a map whose chain is loose before a place: both ends of the drive are right."""
    chain = np.array(atlas.chain)
    return np.concatenate([chain[:place], compose(truth[-1], between(chain[-1], chain[place:]))])


@pytest.mark.parametrize("place", [AT - 6, AT, AT + 5])
def test_scans_find_the_node_of_a_carry_from_a_place_nearby(carried, place):
    atlas, truth = carried
    found = known(divide(atlas, place, loosened(atlas, truth, place)))
    assert found.node == AT
    assert not found.evidence.passed


def test_scans_do_not_part_a_chain_that_is_right(carried):
    _, truth = carried
    drove = np.concatenate([truth[:AT], compose(truth[AT - 1], between(truth[AT], truth[AT:]))])
    wrong = np.concatenate([drove[:AT], compose(drove[AT:], np.array([1.0, 0.0, 0.0]))])
    assert known(divide(atlas_of(drove, drove), AT, wrong)).evidence.passed


def test_scans_tell_nothing_where_the_map_has_no_others():
    way = ring_drive(0.5)[::EVERY]
    assert divide(atlas_of(way, way), len(way) // 2, way) is None


def test_a_piece_that_lies_wholly_after_a_kidnapping_is_not_parted_again(carried):
    atlas, truth = carried
    place = AT + 4
    atlas.part(AT)
    assert divide(atlas, place, loosened(atlas, truth, place)) is None
    atlas.join(AT)


def test_scans_on_either_side_of_a_jump_between_two_nodes_are_put_right():
    way = ring_drive(1.0)[:200]
    up = 102
    truth = np.concatenate([way[:up], way[up + CARRIED :]])
    nodes = truth[::EVERY]
    felt = np.concatenate([way[:up], compose(way[up], between(way[up + CARRIED], way[up + CARRIED :]))])
    atlas = atlas_of(nodes, nodes)
    scans = [
        ObservedScan(LaserScan(100 * i, cast(ring(), truth[i])), i // EVERY, between(felt[EVERY * (i // EVERY)], felt[i]))
        for i in range(len(truth))
    ]
    steps = between(felt[::EVERY][:-1], felt[::EVERY][1:])
    anchors = DenseTrajectory(atlas, LASER).dense_trajectory(scans, steps, nodes)
    jump = [100 * i for i in range(up - 1, up + 3)]
    assert set(jump) <= set(anchors.stamps_ns.tolist())
    off = between(truth[anchors.stamps_ns // 100], compose(nodes[anchors.nodes], anchors.deltas))
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.05
