"""Where four visits know a place, the robot is followed on the nodes that exist, and the map does not grow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from hybridmap import checkpoints, session
from hybridmap.config import Config
from hybridmap.edge_book import Position
from hybridmap.errors import StreamError
from hybridmap.geometry import RelativePose, align, between, compose
from hybridmap.graph.paths import require_connected
from hybridmap.known_places import KnownPlaces
from hybridmap.mapper import Mapper
from hybridmap.sessions.joining import merge
from hybridmap.store import MapStore
from hybridmap.streams.base import Sample, SelfMotion, StreamReport
from hybridmap.streams.laser import LASER, LaserScan
from hybridmap.trajectory import NS_PER_S, Trajectory, read_tum
from hybridmap.vision.base import Belief
from hybridmap.vision.laser.front_end import LaserFrontEnd
from tests.streams_for_tests import BEARINGS, WALLS, RoomDrive, scan

LAP = 126  # steps
CHANGED = np.concatenate([WALLS[:9], [[-1.8, -1.9, -1.8, 2.4], [-1.8, 1.9, 3.0, 1.9], [2.2, -1.0, 2.2, 1.2]]])
"""The pillar has gone, and there are three new walls."""


@dataclass
class Laps(RoomDrive):
    """Laps of the room; after `aside` of them once round a smaller circle; the room changes after `changed`."""

    aside: int | None = None
    changed: int | None = None
    late_s: float = 0.0
    breaks_after: int | None = None
    report: StreamReport = field(default_factory=StreamReport)

    def _true_poses(self) -> np.ndarray:
        steps = [np.array([0.06, 0.0, 2.0 * np.pi / LAP])] * round(LAP * self.laps)
        if self.aside is not None:
            at = self.aside * LAP + LAP // 2
            steps[at:at] = [np.array([0.06, 0.0, -0.1])] * 63
        if self.late_s:  # only where the turn rate varies can the clock be told
            steps = [step * (1.0 + 0.7 * np.sin(2.0 * np.pi * i / 21)) for i, step in enumerate(steps)]
        poses = [np.array([0.0, -1.2, 0.0])]
        for step in steps:
            poses.append(compose(poses[-1], step))
        return np.array(poses)

    def __iter__(self) -> Iterator[Sample]:
        rng, odom, poses = np.random.default_rng(1), np.zeros(3), self._true_poses()
        late_ns = round(self.late_s * NS_PER_S)
        for i, pose in enumerate(poses):
            if i == self.breaks_after:
                raise StreamError("the cable is loose")
            stamp_ns = i * NS_PER_S // 10
            if i > 0:
                noise = rng.normal(0.0, [0.001, 0.0, 0.002]) + np.array([0.0, 0.0, 0.03 * 0.06])
                odom = compose(odom, between(poses[i - 1], pose) + noise)
            yield SelfMotion(stamp_ns, odom)
            if i % 2 == 0:
                walls = CHANGED if self.changed is not None and i >= self.changed * LAP else WALLS
                ranges = scan(compose(pose, np.array([0.1, 0.0, 0.0])), walls)
                yield LaserScan(stamp_ns + late_ns, ranges + rng.normal(0, 0.01, len(BEARINGS)).astype(np.float32))


def config(**more: object) -> Config:
    return Config.load("laser", {"backends.names": ["gtsam-gnc"], "neural.modules": 0, **more})


def mapped(stream: RoomDrive, settings: Config | None = None) -> tuple[Mapper, list[int]]:
    """The mapper after a drive, and the number of nodes at the end of each lap."""
    mapper, nodes = Mapper(settings or config(), stream.rig), list[int]()
    for sample in stream:
        mapper.add(sample)
        if sample.stamp_ns * 10 >= (len(nodes) + 1) * LAP * NS_PER_S:
            nodes.append(len(mapper.map))
    mapper.finish()
    return mapper, nodes


def error_m(trajectory: Trajectory, truth: Trajectory) -> float:
    true = truth.at(trajectory.stamps_ns)
    off = compose(align(true, trajectory.poses), trajectory.poses) - true
    return float(np.hypot(off[:, 0], off[:, 1]).max())


def test_the_map_of_many_laps_is_that_of_four_and_no_node_moves():
    stream = Laps(laps=8.0)
    mapper, nodes, moved = Mapper(config(), stream.rig), list[int](), list[np.ndarray]()
    for sample in stream:
        for update in mapper.add(sample):
            if update.followed:
                assert update.new_node is None
                assert update.edges == ()
                moved.append(mapper.poses())
        if sample.stamp_ns * 10 >= (len(nodes) + 1) * LAP * NS_PER_S:
            nodes.append(len(mapper.map))
    assert nodes[3] > 3 * nodes[0]  # until then each visit leaves nodes
    assert nodes[-1] <= 1.1 * nodes[4]
    assert mapper.known_places.followed == len(moved) > 30
    last = [poses for poses in moved if len(poses) == len(moved[-1])]
    assert all(np.array_equal(poses, last[-1]) for poses in last)


@pytest.mark.slow
def test_a_node_at_every_visit_can_be_asked_for():
    mapper, nodes = mapped(Laps(laps=6.0), config(**{"nodes.rule": "every-visit", "backends.names": ["gtsam-gnc"]}))
    assert nodes[-1] > 1.15 * nodes[4]
    assert mapper.known_places.followed == 0


def test_the_trajectory_of_a_followed_robot_is_right_and_in_the_session(tmp_path):
    stream = Laps(laps=6.5)
    done = session.run(stream, config(), tmp_path / "s")
    for name in ("gtsam-gnc", "gtsam-gnc_online"):
        trajectory = read_tum(done.folder.trajectory / f"{name}.tum")
        assert len(trajectory) == len(stream.groundtruth)
        assert error_m(trajectory, stream.groundtruth) < 0.05
    with MapStore.open(tmp_path / "s") as store:
        account = store.info("known_places")
    figures = {metric.name: metric.value for metric in done.metrics}
    assert account == {"followed": int(figures["nodes_reused"]), "outdated": []}


def test_nodes_are_made_again_where_the_robot_leaves_the_known_way():
    stream = Laps(laps=6.5, aside=5)
    mapper, nodes = mapped(stream)
    graph = mapper.map.pose_graph()
    require_connected(graph)
    assert 8 <= nodes[-1] - nodes[4] <= 20  # those of the small circle
    resumed = int(np.flatnonzero(mapper.map.stamps_ns > 5 * LAP * NS_PER_S // 10)[0])
    into = [mapper.map.edge(number) for number in mapper.map.edges_into(resumed)]
    assert min(edge.source for edge in into) < resumed - 1  # seen from an older node
    assert any(edge.source == resumed - 1 for edge in into)
    truth = stream.groundtruth.at(mapper.map.stamps_ns)
    off = compose(align(truth, mapper.poses()), mapper.poses()) - truth
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.04


def test_the_map_of_a_followed_robot_is_taken_up_as_it_was(tmp_path):
    stream = Laps(laps=6.5, aside=5)
    session.run(stream, config(), tmp_path / "a")
    session.run(RoomDrive(laps=1.4), config(), tmp_path / "b")
    joint = merge([tmp_path / "a", tmp_path / "b"], tmp_path / "c")
    assert joint.joined
    with MapStore.open(tmp_path / "a") as store:
        front_end = LaserFrontEnd(config().vision, store.rig.sensors[LASER.sensor_name])
        count = len(store.map())
        resumed = [node for node in range(count) if "back" in store.state(node)]
        for node in range(count):
            front_end.restore(node, store.keyframe(node), store.state(node), node == 0)
    assert resumed == [piece.start for piece in front_end.atlas.pieces[1:]] != []
    assert all(front_end.atlas.before(node) < node - 1 for node in resumed)
    assert len(front_end.atlas) == count


@pytest.mark.slow
def test_the_odometry_of_a_followed_robot_is_measured_again_where_its_clock_was_off(tmp_path):
    stream = Laps(laps=6.5, aside=5, late_s=0.15)
    done = session.run(stream, config(), tmp_path / "s")
    figures = {metric.name: metric.value for metric in done.metrics}
    assert figures["clock_offset_used"] == pytest.approx(0.15, abs=0.03)
    assert figures["nodes_reused"] > 10
    trajectory = read_tum(done.folder.trajectory / "gtsam-gnc.tum")
    late = Trajectory(stream.groundtruth.stamps_ns + round(0.15 * NS_PER_S), stream.groundtruth.poses)
    inside = trajectory.stamps_ns >= late.stamps_ns[0]
    assert error_m(Trajectory(trajectory.stamps_ns[inside], trajectory.poses[inside]), late) < 0.06


@pytest.mark.slow
def test_a_changed_room_is_mapped_anew_and_then_known_again():
    _, nodes = mapped(Laps(laps=12.0, changed=6))
    assert nodes[4] == nodes[5]  # the room as it was is known
    assert nodes[6] >= nodes[5] + 12  # and as it is now it is not
    assert nodes[-1] == nodes[-2]


class Looks(LaserFrontEnd):
    """A front-end at one place, whose view fits the given nodes only."""

    follows, lost_since = True, None

    def __init__(self) -> None:
        self.fits: set[int] = set()
        self.tried: list[int] = []
        self.at = -1

    def recognise(self, node: int, expected: np.ndarray) -> RelativePose | None:
        self.tried.append(node)
        return RelativePose(expected, np.eye(3)) if node in self.fits else None

    def follow(self, node: int) -> None:
        self.at = node


def find(places: KnownPlaces, vision: Looks, count: int, sigma_m: float = 0.1) -> tuple[int | None, list[int]]:
    """Look for the robot at a place with one node of each of `count` visits; returns where it is, and what was tried."""
    stamps_ns = np.arange(count + 1) * 60 * NS_PER_S
    poses = np.zeros((count + 1, 3))
    robot = Position(config().edges, "gtsam-gnc")
    robot.stamp_ns, robot.at_node = int(stamps_ns[-1]), count
    covariance = np.tile(np.eye(3) * sigma_m**2, (count + 1, 1, 1))
    belief = Belief(poses, stamps_ns / NS_PER_S, np.arange(count + 1.0), lambda _: covariance)
    vision.tried = []
    found = places.find(stamps_ns, poses, robot, np.array([0.1, 0.0, 0.0]), lambda: belief)
    return None if found is None else found.node, vision.tried


def test_a_place_is_known_from_four_visits_and_a_certain_map():
    vision = Looks()
    vision.fits = set(range(9))
    places = KnownPlaces(config(), vision)
    assert find(places, vision, 3) == (None, [])
    assert find(places, vision, 4, sigma_m=0.5) == (None, [])
    assert find(places, vision, 4) == (3, [3])  # the newest visit
    assert vision.at == 3


def test_a_view_that_failed_three_times_is_tried_no_more_unless_it_fits_in_between():
    vision = Looks()
    places = KnownPlaces(config(), vision)
    vision.fits = {4}
    for _ in range(2):
        assert find(places, vision, 6) == (4, [5, 4])
    vision.fits = {5}
    assert find(places, vision, 6) == (5, [5])
    vision.fits = {4}
    for _ in range(3):
        assert find(places, vision, 6) == (4, [5, 4])
    assert find(places, vision, 6) == (4, [4])
    assert places.outdated == [5]
    vision.fits = set()
    assert find(places, vision, 6) == (None, [4, 3, 2])


def test_a_run_that_breaks_off_while_the_robot_is_followed_is_resumed(tmp_path, monkeypatch):
    after = 5.4 * LAP
    for name, value in (("LEAST_S", 0.0), ("AHEAD_S", 1e9), ("SOON", 0.0)):
        monkeypatch.setattr(checkpoints, name, value)
    with pytest.raises(StreamError, match="cable"):
        session.run(Laps(laps=5.6, breaks_after=int(after)), config(), tmp_path / "s")
    first: list[int] = []
    resumed = session.run(Laps(laps=5.6), config(), tmp_path / "s", resume=True, progress=lambda done, _: first.append(done))
    assert first[0] > after / 2 - 10  # it goes on from the last node that was found
    unbroken = session.run(Laps(laps=5.6), config(), tmp_path / "u")
    assert resumed.head["graph_hash"] == unbroken.head["graph_hash"]
    ours, theirs = (one.folder.trajectory / "gtsam-gnc.tum" for one in (resumed, unbroken))
    assert ours.read_bytes() == theirs.read_bytes()
