"""A kind of sensor that the package does not know, a ring of eight sonars, added by its table alone."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybridmap import session
from hybridmap.cli.choose import choose
from hybridmap.config import Config
from hybridmap.config.inputs import SensorsConfig
from hybridmap.config.vision import VisionConfig
from hybridmap.errors import ConfigError, StreamError
from hybridmap.export.formats import export_session
from hybridmap.geometry import Array, RelativePose, transform_points
from hybridmap.graph.edges import Edge
from hybridmap.mapper import Mapper
from hybridmap.metrics import StageClock
from hybridmap.plugins import Table
from hybridmap.report import write_report
from hybridmap.store import MapStore
from hybridmap.streams import sensors
from hybridmap.streams.bagindex import BagIndex, TopicChooser
from hybridmap.streams.base import InBag, Keyframe, Observation, Planned, Rig, Seen, SelfMotion, SensorKind, SensorPlan
from hybridmap.streams.inspection import inspect_source
from hybridmap.streams.order import sorted_order
from hybridmap.streams.rosbag import BagStream
from hybridmap.vision.base import Belief, View
from tests.streams.recordings import NS, Recording

HALF_ROOM_M = 3.0
TYPE = "sensor_msgs/msg/PointCloud"
BEARINGS = (np.arange(8) + 0.5) * np.pi / 4


@dataclass(frozen=True, slots=True)
class Ring:
    """Eight sonars on a circle."""

    bearings_rad: np.ndarray
    pose_base_ring: np.ndarray
    range_max_m: float = 5.0


@dataclass(frozen=True, slots=True)
class Echoes(Observation):
    """What they heard, m; NaN where nothing came back."""

    ranges_m: np.ndarray


class EchoDecoder:
    """The points of a message -> ranges."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}

    def __call__(self, stamp_ns: int, parts: tuple[Any, ...]) -> Echoes:
        return Echoes(stamp_ns, np.array([np.hypot(p.x, p.y) for p in parts[0].points], dtype=np.float32))


class SonarFrontEnd:
    """Sees, keeps, and closes no loop."""

    def __init__(self, config: VisionConfig, rig: Rig, seed: int, clock: StageClock) -> None:
        self.ring = rig.sensors["ring"]
        self.kept: list[dict[str, np.ndarray]] = []

    lost_since: int | None = None

    def observe(self, frame: Observation, delta_node_robot: Array) -> View:
        assert isinstance(frame, Echoes)
        self.frame = frame
        return View(frame.stamp_ns, frame.ranges_m[None], -1, False)

    def add_node(self, node: int, view: View) -> None:
        self.kept.append({"profile": view.profile, **SONAR.compact(self.frame)})

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        return []

    def close(self, node: int, belief: Belief) -> list[Edge]:
        return []

    def finish(self, belief: Belief) -> list[Edge]:
        return []

    def keyframe(self, node: int) -> dict[str, np.ndarray]:
        return self.kept[node]


def find(chooser: TopicChooser) -> dict[str, str]:
    topic = chooser.best((TYPE,), (r"sonar",))
    return {} if topic is None else {"sonar": topic}


def plan(topics: Mapping[str, str], index: BagIndex, base_frame: str, config: SensorsConfig, source: str) -> SensorPlan:
    if not topics:
        raise StreamError(f"{source}: no sonar")
    topic = topics["sonar"]
    points = index.first[topic].points
    bearings = np.array([np.arctan2(p.y, p.x) for p in points])
    mounting = index.transforms.require(base_frame, index.frame_of(topic), source, "a transform")
    stamps = np.array(index.stamps_ns[topic])
    planned = [Planned(int(stamps[i]), ((topic, int(i)),)) for i in sorted_order(stamps, source)]
    return SensorPlan(Rig(ring=Ring(bearings, np.array([*mounting[:2, 3], 0.0]))), planned, EchoDecoder())


def see(keyframe: Keyframe, ring: Ring, max_range_m: float) -> Seen | None:
    if "echoes_mm" not in keyframe:
        return None
    ranges = keyframe["echoes_mm"] / 1000.0
    heard = (ranges > 0) & (ranges < max_range_m)
    ends = ranges[:, None] * np.stack([np.cos(ring.bearings_rad), np.sin(ring.bearings_rad)], axis=1)
    ends = transform_points(ring.pose_base_ring, ends)[heard]
    xyz = np.column_stack([ends, np.full(len(ends), 0.2)])
    return Seen(xyz, None, ring.pose_base_ring[:2], ring.bearings_rad[heard])


SONAR = SensorKind(
    name="sonar",
    sensor_name="ring",
    sensor=Ring,
    sample=Echoes,
    counted="echoes",
    needs="sonar echoes",
    words=lambda ring: f"ring of {len(ring.bearings_rad)} sonars",
    front_end=SonarFrontEnd,
    compact=lambda echoes: {"echoes_mm": np.rint(np.nan_to_num(echoes.ranges_m) * 1000).astype(np.uint16)},
    restore=lambda keyframe, stamp_ns: (
        Echoes(stamp_ns, (keyframe["echoes_mm"] / 1000).astype(np.float32)) if "echoes_mm" in keyframe else None
    ),
    see=see,
    in_bag=InBag((TYPE,), find, plan),
)


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kind is there for one test."""
    ours = {kind.name: kind for kind in sensors.kinds()}
    monkeypatch.setattr(sensors, "SENSORS", Table("kind of sensor", ours, "hybridmap.sensors", ConfigError))
    sensors.register(SONAR)


def echoes(pose: np.ndarray) -> np.ndarray:
    """Ranges to the walls of a square room, from a pose of the ring."""
    yaw = pose[2] + BEARINGS
    reach = [(np.sign(d) * HALF_ROOM_M - p) / d for d, p in ((np.cos(yaw), pose[0]), (np.sin(yaw), pose[1]))]
    nearest: np.ndarray = np.minimum(*reach)
    return nearest


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    recording = Recording()
    recording.transform("base_link", "ring", (0.1, 0.0, 0.2))
    for i in range(60):
        stamp, x = 100 * NS + i * NS // 10, 0.03 * i - 0.9
        recording.odometry(stamp, x)
        ends = echoes(np.array([x + 0.1, 0.0, 0.0]))[:, None] * np.stack([np.cos(BEARINGS), np.sin(BEARINGS)], axis=1)
        points = [recording.t.Point32(x=float(end[0]), y=float(end[1]), z=0.0) for end in ends]
        message = recording.t.PointCloud(header=recording.header(stamp, "ring"), points=points, channels=[])
        recording.messages.append(("/sonar", TYPE, message))
    return recording.write(tmp_path / "ring.mcap")


@pytest.mark.parametrize("sensor", ["auto", "sonar"])
def test_a_bag_is_mapped_stored_exported_and_shown(bag: Path, tmp_path: Path, sensor: str) -> None:
    o3d = pytest.importorskip("open3d")
    chosen = choose(str(bag), None, {"vision.sensor": sensor, "backends.names": ["odometry"]})
    finished = session.run(chosen.stream, chosen.config, tmp_path / "out")
    assert finished.head["stream"] == {"odometry": 60, "echoes": 60}
    with MapStore.open(tmp_path / "out") as store:
        first = store.map().node(0)
        np.testing.assert_allclose(store.rig.sensors["ring"].pose_base_ring, [0.1, 0.0, 0.0])
        back = SONAR.restore(store.keyframe(0), first.stamp_ns)
        assert isinstance(back, Echoes)
        np.testing.assert_allclose(back.ranges_m, echoes(np.array([-0.8, 0.0, 0.0])), atol=1e-3)
    export_session(tmp_path / "out", "ply", tmp_path / "cloud.ply")
    points = np.asarray(o3d.io.read_point_cloud(str(tmp_path / "cloud.ply")).points)
    points[:, 0] -= 0.9  # the map begins where the drive does
    np.testing.assert_allclose(np.abs(points[:, :2]).max(axis=1), HALF_ROOM_M, atol=0.05)
    export_session(tmp_path / "out", "grid", tmp_path / "grid")
    assert (tmp_path / "grid.pgm").is_file()
    assert "over what the robot saw" in write_report(finished.folder).read_text()


def test_inspect_says_what_it_would_map_with(bag: Path) -> None:
    found = inspect_source(bag, choose(str(bag), None, {}).config)
    assert found.mappable
    assert found.uses == {"odometry": "/odom", "sonar": "/sonar"}
    assert sensors.words(found.rig) == ["ring of 8 sonars"]


def test_what_a_bag_lacks_is_said_in_the_words_of_the_kind(tmp_path: Path) -> None:
    recording = Recording()
    for i in range(3):
        recording.odometry(100 * NS + i * NS // 10, 0.1 * i)
    path = recording.write(tmp_path / "bare.mcap")
    stream = choose(str(path), None, {}).stream
    assert isinstance(stream, BagStream)
    assert "sonar echoes" in stream.remarks[-1]
    with pytest.raises(StreamError, match="no sonar"):
        choose(str(path), None, {"vision.sensor": "sonar"})


def test_the_mapper_takes_its_samples_one_by_one() -> None:
    chosen = {"vision.sensor": "sonar", "nodes.distance_m": 0.1, "backends.names": ["odometry"]}
    ring = Ring(BEARINGS, np.zeros(3))
    mapper = Mapper(Config.load(None, chosen), Rig(ring=ring))
    made = []
    for i in range(20):
        mapper.add(SelfMotion(i * NS, np.array([0.05 * i, 0.0, 0.0])))
        made += mapper.add(Echoes(i * NS, echoes(np.array([0.05 * i, 0.0, 0.0])).astype(np.float32)))
    assert [update.new_node for update in made if update.new_node is not None] == list(range(len(mapper.map)))
    assert len(mapper.map) >= 8
    with pytest.raises(StreamError, match="sonar echoes"):
        Mapper(Config.load(None, chosen), Rig())


def test_nothing_but_streams_vision_the_simulator_and_disturbances_asks_for_one_sensor() -> None:
    own = ("streams/", "vision/", "simulation/", "study/disturb.py")
    asks = re.compile(r"\brig\.(laser|camera)\b|sensors(\.get\(|\[)\"(laser|camera)\"|\b(LASER|RGBD)\b")
    package = Path(__file__).resolve().parents[1] / "hybridmap"
    files = {str(path.relative_to(package)): path.read_text() for path in package.rglob("*.py")}
    assert [name for name, text in files.items() if asks.search(text) and not name.startswith(own)] == []


def test_a_name_is_given_once() -> None:
    with pytest.raises(ConfigError, match="sonar"):
        sensors.register(SONAR)
