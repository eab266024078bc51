"""The gain of the wheels by what the views see of the way: put to use at once, and at the end for the whole drive."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from hybridmap.calibration.online import OdometryWatch
from hybridmap.config import Config
from hybridmap.geometry import between, compose
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.neural import PathIntegrator
from hybridmap.streams.synchronise import Synchroniser
from hybridmap.vision.base import GaugingFrontEnd, SeenGain, View
from tests.narrowing import known

TRUE_GAIN, NODES, SECOND_NS = 0.95, 12, 10**9
STEP = np.array([0.4, 0.0, 0.1])


@dataclass
class Views:
    """A front-end that sees how far the robot came, from its fifth node on; it sees nothing else."""

    true_gain: float = TRUE_GAIN
    sigma: float = 0.002
    knows_at: int = 5
    nodes: int = 0
    told: float = 1.0
    rescaled: list[float] = field(default_factory=list)
    lost_since: None = None

    @property
    def gain(self):
        return SeenGain(self.true_gain / self.told, self.sigma, self.nodes) if self.nodes >= self.knows_at else None

    def rescale(self, factor):
        self.rescaled.append(factor)
        self.told *= factor

    def observe(self, frame, delta_node_robot):
        return View(0, np.zeros((1, 1), np.float32), -1, False)

    def add_node(self, node, view):
        pass

    def track(self, node, odometry):
        return []

    def close(self, node, belief):
        return []

    def finish(self, belief):
        return []

    def keyframe(self, node):
        return {}


class Driven:
    """Nodes every 0.4 m of raw odometry, with the gain in use at the time."""

    def __init__(self, views, online=True):
        config = Config.load(None, {"calibration.online": online})
        integrator = PathIntegrator(config.neural)
        self.watch = OdometryWatch(config, integrator, Synchroniser(0.0, 0.0))
        self.views, self.map, pose, self.gains, self.reasons = views, ExperienceMap(), np.zeros(3), [], []
        for node in range(NODES):
            self.map.add_node(Node(node * SECOND_NS, pose, np.zeros(1, np.float32), -1, 0.4 * node), pose)
            views.nodes += 1
            self.reasons.append(self.watch.follow(self.map, lambda: self.map.initial, views))
            self.gains.append(integrator.gains.gain)
            pose = compose(pose, STEP * [self.gains[-1], self.gains[-1], 1.0])
        self.end = pose
        self.again = self.watch.finish(self.map, views, NODES * SECOND_NS, pose)


def test_the_stub_is_what_the_interface_asks_for():
    assert isinstance(Views(), GaugingFrontEnd)


def test_a_gain_is_used_from_the_node_on_where_it_is_known_and_said_once():
    driven = Driven(Views())
    assert driven.gains == [1.0] * 4 + [pytest.approx(TRUE_GAIN)] * (NODES - 4)
    assert driven.views.rescaled == [pytest.approx(TRUE_GAIN)]
    assert [bool(reason) for reason in driven.reasons] == [k == 4 for k in range(NODES)]
    assert [change.stamp_ns for change in driven.watch.changes] == [4 * SECOND_NS]


@pytest.mark.parametrize("knows_at", [5, NODES])
def test_at_the_end_the_whole_drive_is_measured_with_it(knows_at):
    driven = Driven(Views(knows_at=knows_at))
    again = known(driven.again)
    steps = between(again.poses_odom[:-1], again.poses_odom[1:])
    assert len(steps) == NODES
    assert steps == pytest.approx(np.tile(STEP * [TRUE_GAIN, TRUE_GAIN, 1.0], (NODES, 1)))
    assert known(again.gains).gain == pytest.approx(TRUE_GAIN)
    assert driven.watch.remeasured is again


def test_poses_between_nodes_follow():
    driven = Driven(Views())
    stamps, driven_poses, true = [], [], []
    again = known(driven.again)
    for node in (0, 2, 3, 4, 8):
        half = np.array([0.2, 0.0, 0.05])
        stamps.append(node * SECOND_NS + SECOND_NS // 2)
        driven_poses.append(compose(driven.map.node(node).pose_odom, half * [driven.gains[node], driven.gains[node], 1.0]))
        true.append(compose(again.poses_odom[node], half * [TRUE_GAIN, TRUE_GAIN, 1.0]))
    assert again.poses_at(np.array(stamps), np.array(driven_poses)) == pytest.approx(np.array(true))
    ends = np.array([0, NODES * SECOND_NS])
    assert again.poses_at(ends, np.array([np.zeros(3), driven.end])) == pytest.approx(again.poses_odom[[0, -1]])


@pytest.mark.parametrize("views", [Views(true_gain=1.003), Views(true_gain=-0.2), Views(true_gain=30.0), Views(knows_at=99)])
def test_what_may_be_chance_or_is_no_robots_gain_changes_nothing(views):
    driven = Driven(views)
    assert driven.gains == [1.0] * NODES
    assert driven.again is None
    assert driven.watch.changes == []


def test_nothing_changes_unless_asked_for():
    driven = Driven(Views(), online=False)
    assert driven.gains == [1.0] * NODES
    assert driven.again is None
