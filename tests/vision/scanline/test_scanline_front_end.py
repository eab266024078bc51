"""The scanline front-end on scans of a room: no pictures, no back-end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridmap import vision
from hybridmap.config.vision import VisionConfig
from hybridmap.errors import ConfigError, StreamError
from hybridmap.geometry import RelativePose, between, compose
from hybridmap.graph.edges import Edge, Status
from hybridmap.plugins import Table
from hybridmap.streams.base import Rig
from hybridmap.streams.laser import Laser, LaserScan
from hybridmap.streams.rgbd import Camera
from hybridmap.vision import Factory, create_front_end
from hybridmap.vision.base import HELD_IMAGES, Belief, GaugingFrontEnd
from hybridmap.vision.scanline.front_end import ScanlineFrontEnd
from hybridmap.vision.scanline.retina import LaserRetina
from tests.narrowing import known
from tests.streams_for_tests import BEARINGS, scan

LASER = Laser(BEARINGS, 0.05, 30.0, np.zeros(3))
LEVEL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5, LEVEL)
CONFIG = VisionConfig.model_validate({"closing": {"by": "scanline"}, "profile": {"width": 90}, "matching": {"sequence": 4}})
GAIN = 1.04


def laps(count):
    """Poses on laps in the room: straights of steps of 0.25 m, and corners in steps of 15 deg; each lap a little aside."""
    rng, out = np.random.default_rng(0), []
    corners = np.array([[-1.5, -1.2], [2.2, -1.2], [2.2, 1.6], [-1.5, 1.6]])
    for _ in range(count):
        moved, phase = corners + rng.normal(scale=0.05, size=corners.shape), rng.uniform()
        for k in range(4):
            start, end, after = moved[k], moved[(k + 1) % 4], moved[(k + 2) % 4]
            heading = np.arctan2(*(end - start)[::-1])
            steps = max(int(np.hypot(*(end - start)) / 0.25), 1)
            out += [[*(start + (end - start) * (i + phase) / steps), heading] for i in range(steps)]
            turn = between(np.array([0.0, 0.0, heading]), np.array([0.0, 0.0, np.arctan2(*(after - end)[::-1])]))[2]
            out += [[*end, heading + turn * i / 6] for i in range(6)]
    return np.array(out)


class Driven:
    """A drive by wheels that tell ways too long; the map is that of odometry, put right by the truth now and then."""

    def __init__(self, poses, front_end=None, turned_rad=0.0):
        self.front_end = front_end or ScanlineFrontEnd(CONFIG, retina_of())
        self.loops: dict[int, Edge] = {}
        odometry = [poses[0]]
        for node, pose in enumerate(poses):
            step = between(poses[node - 1], pose) * [GAIN, GAIN, 1.0] if node else None
            odometry += [compose(odometry[-1], step)] if step is not None else []
            view = self.front_end.observe(LaserScan(node * 10**9, scan(pose + np.array([0.0, 0.0, turned_rad]))), np.zeros(3))
            self.front_end.add_node(node, view)
            assert self.front_end.track(node, None if step is None else RelativePose(step, np.eye(3))) == []
            self.belief = belief(poses[: node + 1])
            self.loops |= {edge.key: edge for edge in self.front_end.close(node, self.belief)}

    @property
    def accepted(self):
        return [edge for edge in self.loops.values() if edge.status is Status.ACCEPTED]


def retina_of():
    return LaserRetina(CONFIG, LASER)


def belief(poses):
    steps = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
    return Belief(poses, np.arange(float(len(poses))), np.cumsum(steps), lambda _: np.zeros((len(poses), 3, 3)))


@pytest.fixture(scope="module")
def poses():
    return laps(3)


@pytest.fixture(scope="module")
def driven(poses):
    return Driven(poses)


def test_later_laps_close_on_earlier_ones_and_tell_heading_and_way(driven, poses):
    assert len(driven.accepted) > 10
    gaps = np.array([between(between(poses[e.source], poses[e.target]), e.relative.delta) for e in driven.accepted])
    assert np.hypot(gaps[:, 0], gaps[:, 1]).max() < 0.5
    assert np.rad2deg(np.abs(gaps[:, 2])).max() < 5.0
    assert np.median(np.abs(gaps[:, 0])) < 0.02


def test_a_laser_that_looks_back_tells_the_way_by_where_g_is_least(poses):
    back = replace(LASER, pose_base_laser=np.array([0.0, 0.0, np.pi]))
    driven = Driven(poses, ScanlineFrontEnd(CONFIG, LaserRetina(CONFIG, back)), turned_rad=np.pi)
    assert driven.front_end.gain is None
    assert len(driven.accepted) > 10
    assert not any(edge.figures["by depth"] for edge in driven.accepted)
    true = np.array([between(poses[e.source], poses[e.target])[0] for e in driven.accepted])
    along = np.array([known(e.relative).delta[0] for e in driven.accepted])
    assert np.corrcoef(true, along)[0, 1] > 0.5
    assert np.abs(along - true).mean() < 0.8 * np.abs(true).mean()


def test_the_depth_ahead_tells_the_gain_of_the_wheels(driven):
    gain = known(driven.front_end.gain)
    assert gain.gain == pytest.approx(1.0 / GAIN, abs=0.01)
    assert isinstance(driven.front_end, GaugingFrontEnd)


def test_the_end_gives_up_what_waits_once(poses):
    one = Driven(poses[: len(poses) // 2])
    assert not any(edge.status is Status.ACCEPTED for edge in one.front_end.finish(one.belief))
    assert one.front_end.finish(one.belief) == []
    assert one.front_end.lost_since is None


def test_scans_without_any_return_are_taken_and_match_nothing(poses):
    front_end = ScanlineFrontEnd(CONFIG, retina_of())
    nothing = np.full(len(BEARINGS), np.nan, np.float32)
    for node in range(len(poses)):
        front_end.add_node(node, front_end.observe(LaserScan(node * 10**9, nothing), np.zeros(3)))
        front_end.track(node, RelativePose(between(poses[node - 1], poses[node]), np.eye(3)) if node else None)
        assert front_end.close(node, belief(poses[: node + 1])) == []
    assert front_end.gain is None


def test_the_frames_of_the_newest_nodes_are_held():
    front_end = ScanlineFrontEnd(CONFIG, retina_of())
    for node in range(HELD_IMAGES + 1):
        front_end.add_node(node, front_end.observe(LaserScan(node, scan(np.zeros(3))), np.zeros(3)))
    assert set(front_end.keyframe(HELD_IMAGES)) == {"profile", "ranges_m"}
    assert set(front_end.keyframe(1)) == {"profile", "ranges_m"}
    with pytest.raises(StreamError, match="map file"):
        front_end.keyframe(0)


def test_nodes_are_made_in_order_of_what_was_observed():
    front_end = ScanlineFrontEnd(CONFIG, retina_of())
    view = front_end.observe(LaserScan(0, scan(np.zeros(3))), np.zeros(3))
    with pytest.raises(ValueError, match="node 1"):
        front_end.add_node(1, view)
    with pytest.raises(ValueError, match="node 0"):
        ScanlineFrontEnd(CONFIG, retina_of()).add_node(0, view)


@pytest.mark.parametrize(("sensor", "reads"), [("auto", LaserScan), ("laser", LaserScan), ("rgbd", None)])
def test_of_a_rig_with_both_the_setting_chooses_and_the_laser_comes_first(sensor, reads):
    config = CONFIG.model_copy(update={"sensor": sensor})
    front_end = known(create_front_end(config, Rig(laser=LASER, camera=CAMERA), 0))
    frame = LaserScan(0, scan(np.zeros(3)))
    if reads is not None:
        assert front_end.observe(frame, np.zeros(3)).profile.shape == (1, 90)
    else:
        with pytest.raises(StreamError, match="camera"):
            front_end.observe(frame, np.zeros(3))


def test_without_a_sensor_there_is_no_front_end():
    assert create_front_end(CONFIG.model_copy(update={"sensor": "none"}), Rig(laser=LASER), 0) is None
    assert create_front_end(CONFIG, Rig(), 0) is None
    with pytest.raises(StreamError):
        create_front_end(CONFIG.model_copy(update={"sensor": "rgbd"}), Rig(laser=LASER), 0)


def test_a_front_end_of_a_plug_in_is_not_replaced_unsaid(monkeypatch):
    table: Table[Factory] = Table("front-end", {"sonar": lambda *_: None}, "no.such.group", ConfigError)
    monkeypatch.setattr(vision, "FRONT_ENDS", table)
    with pytest.raises(ConfigError, match="sonar"):
        create_front_end(CONFIG.model_copy(update={"sensor": "sonar"}), Rig(laser=LASER), 0)


def test_a_camera_on_its_side_is_refused():
    on_its_side = LEVEL.copy()
    on_its_side[:3, :2] = LEVEL[:3, [1, 0]] * [1.0, -1.0]
    with pytest.raises(ConfigError, match="upright"):
        create_front_end(CONFIG, Rig(camera=replace(CAMERA, T_base_camera=on_its_side)), 0)
