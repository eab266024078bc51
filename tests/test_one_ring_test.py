"""Five places ask whether loops agree through the chain; all of them ask `graph.agreement`."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from hybridmap.backends.judging.clusters import rejected_clusters
from hybridmap.backends.judging.prefilter import consistent_loops
from hybridmap.geometry import RelativePose
from hybridmap.graph.agreement import BOUND, Ring
from hybridmap.graph.edges import Edge, EdgeKind, Search, Status
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.vision.base import Belief
from hybridmap.vision.laser.commitment import Commitment
from hybridmap.vision.laser.hypotheses import Hypothesis
from hybridmap.vision.relocalising import GlobalMatch, Relocaliser, Whereabouts
from hybridmap.vision.rgbd.support import MeasuredLoop, Support

NODES, AGAIN = 60, 30
"""A straight drive; in truth nodes 30.. lie where 0.. lie."""
CHAIN = np.column_stack([0.5 * np.arange(NODES), np.zeros(NODES), np.zeros(NODES)])
STEP = np.diag([1e-3, 1e-3, 1e-3]) ** 2
SEEN = RelativePose(np.zeros(3), np.diag([0.02, 0.02, 0.01]) ** 2)
BELIEF = Belief(CHAIN, np.arange(float(NODES)), CHAIN[:, 0], lambda node: np.abs(np.arange(NODES) - node)[:, None, None] * STEP)
LOOPS = range(0, 24, 6)


def graph():
    pairs = [(k - 1, k) for k in range(1, NODES)] + [(AGAIN + k, k) for k in LOOPS]
    steps, loops = NODES - 1, len(LOOPS)
    return PoseGraph(
        initial=CHAIN,
        sources=np.array([p[0] for p in pairs]),
        targets=np.array([p[1] for p in pairs]),
        deltas=np.array([[0.5, 0.0, 0.0]] * steps + [[0.0, 0.0, 0.0]] * loops),
        information=np.linalg.inv(np.array([STEP] * steps + [SEEN.covariance] * loops)),
        kinds=np.array([EdgeKind.ODOMETRY] * steps + [EdgeKind.LOOP] * loops, dtype=np.int8),
        edge_ids=np.arange(len(pairs)),
    )


def edge(node, key):
    return Edge(AGAIN + node, node, EdgeKind.LOOP, Status.PENDING, SEEN, key=key)


def rejected_loops():
    rejected = tuple(range(NODES - 1, NODES - 1 + len(LOOPS)))
    return len(rejected_clusters(graph(), CHAIN, rejected, BOUND)) > 0


def pre_filter():
    return len(consistent_loops(graph()).loops) > 1


def laser_commitment():
    commitment = Commitment(BELIEF.travel_m.__getitem__)
    for key, node in enumerate(LOOPS):
        commitment.add(key, Hypothesis(AGAIN + node, node, SEEN, 0.7, 0.3, Search.GATE, (), {}, True, 0.0))
    return any(settled.accepted for settled in commitment.settle(BELIEF.travel_m[-1], BELIEF))


def lost_robot():
    relocaliser = Relocaliser(Whereabouts(0), count(100).__next__, 0.75)
    return len(relocaliser.settle([GlobalMatch(edge(node, node)) for node in LOOPS], BELIEF).accepted) > 0


def rgbd_support():
    support = Support()
    filed = [support.file(MeasuredLoop(edge(node, node), SEEN), BELIEF) for node in LOOPS]
    return filed[-1][0].status is Status.ACCEPTED


@pytest.mark.parametrize("agree", [rejected_loops, pre_filter, laser_commitment, lost_robot, rgbd_support])
def test_where_no_ring_closes_no_loops_agree(agree, monkeypatch):
    assert agree()
    monkeypatch.setattr(Ring, "distance", property(lambda ring: np.full(len(ring.error), np.inf)))
    assert not agree()


def asked_of(broken_at=NODES):
    """A belief whose chain has a gap before a node, and the list of nodes whose covariances were asked for."""
    asked = []

    def covariance_from(node):
        asked.append(node)
        unreached = (np.arange(NODES) < broken_at) != (node < broken_at)
        return np.where(unreached[:, None, None], np.diag([np.inf] * 3), BELIEF.covariance_from(node))

    return replace(BELIEF, covariance_from=covariance_from), asked


def test_rgbd_support_asks_for_the_covariances_from_the_new_node_alone_where_loops_agree_as_if_the_map_were_exact():
    support, (belief, asked) = Support(), asked_of()
    for key, node in enumerate(LOOPS[:2]):
        filed = support.file(MeasuredLoop(edge(node, key), SEEN), belief)
    assert [proposal.status for proposal in filed] == [Status.ACCEPTED] * 2
    assert set(asked) == {AGAIN, AGAIN + LOOPS[1]}


def test_rgbd_loops_on_either_side_of_a_gap_in_the_chain_do_not_support_each_other():
    support, (belief, _) = Support(), asked_of(broken_at=AGAIN + 3)
    for key, node in enumerate(LOOPS[:2]):
        filed = support.file(MeasuredLoop(edge(node, key), SEEN), belief)
    assert [proposal.status for proposal in filed] == [Status.PENDING]
