"""While driving: off unless asked for, no change without significance, and every change is said."""

import logging
from functools import partial

import numpy as np
import pytest

from hybridmap.calibration import online
from hybridmap.calibration.estimate import Estimate
from hybridmap.calibration.online import OnlineCalibration
from hybridmap.calibration.regression import regress
from hybridmap.config import Config
from hybridmap.geometry import compose
from hybridmap.graph.edges import EdgeKind
from hybridmap.mapper import Mapper
from hybridmap.odometry_model import NEUTRAL, Gains, remove
from tests.calibration.drives import GAINS, STEP_NS, drive, experience_map
from tests.narrowing import known


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    monkeypatch.setattr(online, "FIRST_M", 30.0)
    monkeypatch.setattr(online, "EVERY_M", 20.0)


def run(gains, registered=True, seed=0):
    """Feed a drive; the map's poses are the truth. Returns the stage and the changes it asked for."""
    rng = np.random.default_rng(seed)
    one = drive(rng, laps=4, gains=gains)
    experiences, chosen = experience_map(one, rng, registered=registered)
    graph, stage = experiences.pose_graph(), OnlineCalibration(NEUTRAL)
    changes: list[online.GainChange | None] = []
    node = {int(at): k for k, at in enumerate(chosen)}
    for index, stamp in enumerate(one.motion.stamps_ns):
        stage.observe(int(stamp), one.motion.steps[index - 1] if index else np.zeros(3))
        if index in node:
            truth = one.truth[chosen[: node[index] + 1]]
            changes.append(stage.follow(int(stamp), lambda: graph, partial(np.copy, truth)))
    return stage, [change for change in changes if change is not None]


def test_off_by_default():
    mapper = Mapper(Config.from_tree({"vision": {"sensor": "none"}}, "test"))
    for k in range(700):
        mapper.add_odometry(0.1 * k, (0.1 * k, 0.0, 0.0))
    assert mapper.calibration.changes == []


def test_a_clear_error_is_corrected_and_said(caplog):
    with caplog.at_level(logging.WARNING):
        stage, changes = run(GAINS)
    assert changes
    assert changes == stage.changes
    assert changes[-1].gains.heading_bias_rad_m == pytest.approx(GAINS.heading_bias_rad_m, abs=0.01)
    assert caplog.text.count("odometry gains changed") == len(changes)
    assert len(changes) <= 3  # once it is right there is nothing more to say


def test_a_gain_that_was_not_measured_stays_and_is_not_said(monkeypatch):
    covariance = np.diag([np.inf, 1e-6, 1e-6, 1e-4])
    estimate = Estimate(Gains(1.0, 0.9, 0.02), 0.0, covariance, 4.0, 20.0, 80.0, 1.0, 0.0)
    monkeypatch.setattr(online, "regress", lambda _: estimate)
    stage = OnlineCalibration(Gains(1.05, 1.0, 0.0))
    rng = np.random.default_rng(0)
    graph = experience_map(drive(rng, laps=1), rng, registered=True)[0].pose_graph()
    for k in range(100):
        stage.observe(k * STEP_NS, np.array([1.0, 0.0, 0.0]))
    change = stage.follow(100 * STEP_NS, lambda: graph, lambda: graph.initial)
    assert known(change).gains == Gains(1.05, 0.9, 0.02)
    assert str(change) == "odometry gains changed: turn gain 0.9000 +- 0.0010, heading bias 0.0200 +- 0.0010"


def test_right_odometry_is_left_alone():
    assert sum(len(run(NEUTRAL, seed=seed)[1]) for seed in range(4)) <= 1


def test_a_map_of_odometry_alone_says_nothing():
    rng = np.random.default_rng(0)
    one = drive(rng, laps=2)

    experiences, chosen = experience_map(one, rng)
    graph, stage = experiences.pose_graph().only(EdgeKind.ODOMETRY), OnlineCalibration(NEUTRAL)
    for index, stamp in enumerate(one.motion.stamps_ns):
        stage.observe(int(stamp), one.motion.steps[index - 1] if index else np.zeros(3))
    assert stage.follow(int(one.motion.stamps_ns[chosen[-1]]), lambda: graph, lambda: one.truth[chosen]) is None


def test_the_mapper_changes_its_integrator_and_says_why(monkeypatch):
    tree = {"vision": {"sensor": "none"}, "calibration": {"online": True}}
    mapper = Mapper(Config.from_tree(tree, "test"))
    wanted = Gains(1.1, 0.9, 0.02)

    def follow(self, stamp_ns, graph, poses):
        if self.changes or len(graph().initial) < 3:
            return None
        estimate = regress([_seen()])
        self.changes.append(online.GainChange(stamp_ns, wanted, estimate))
        return self.changes[-1]

    monkeypatch.setattr(online.OnlineCalibration, "follow", follow)
    pose, reasons = np.zeros(3), []
    for k in range(40):
        reasons += [update.reason for update in mapper.add(_sample(k, pose))]
        pose = compose(pose, remove(np.array([[0.055, 0.0, 0.0]]), NEUTRAL)[0])
    assert sum("odometry gains changed: gain 1.1" in reason for reason in reasons) == 1
    assert mapper.integrator.gains == wanted
    assert mapper.pose_map_robot[2] > 0.01


def _sample(k, pose):
    from hybridmap.streams.base import SelfMotion

    return SelfMotion(k * STEP_NS, pose)


def _seen():
    from tests.calibration.drives import sighting

    return sighting(drive(np.random.default_rng(0)))
