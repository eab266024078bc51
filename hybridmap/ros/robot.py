"""The node without its middleware: it finds the topics, feeds the mapper, and publishes what comes of it."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hybridmap.config.root import Config
from hybridmap.errors import ExportError, HybridMapError, LiveError, RosError, StoreError, StreamError
from hybridmap.geometry import Array, compose
from hybridmap.live import LiveLimits, LiveMapper
from hybridmap.live.locating import require_map
from hybridmap.live.process import MappingProcess
from hybridmap.ros import contents
from hybridmap.ros import middleware as ros
from hybridmap.ros.middleware import Middleware
from hybridmap.ros.services import Services
from hybridmap.ros.shown import PUBLISH_S, Shown
from hybridmap.session import Session
from hybridmap.streams.base import Rig, Sample, SelfMotion
from hybridmap.streams.incoming import Incoming
from hybridmap.streams.messages import Messages, RawMessage, Topic
from hybridmap.streams.sensors import config_for
from hybridmap.trajectory import NS_PER_S

log = logging.getLogger(__name__)

_LOOK_S = 0.5
"""How often topics are looked for until all are there, s. They are taken when two looks give the same: drivers start one after
the other."""
_TELL_S = 5.0
"""How often the operator is told what is missing, s."""
_GRID_WAIT_S = 30.0
KNOWN_MAP = "known_map"
"""Name of the frame of a finished map; the frame of the drive's own map is its child."""
_LONGEST_S = 1.0
"""For how long the stamp of `map -> odom` goes on with the clock when no odometry comes, s."""
_CLOCK_BACK_S = 3.0
"""Stamps that go back by more are those of a clock that was set back."""


@dataclass(frozen=True, slots=True)
class NodeOptions:
    """What a node is started with.

    Attributes:
        out: the session folder.
        config_name: name or path of a configuration; None: that of the sensor found.
        overrides: dotted key -> value over it.
        overwrite: replace a session that exists.
        rate_hz: how often `map -> odom` is published.
        ahead_s: how far its stamp is ahead of the newest odometry, so that others may look up the present.
        map_every_s: time between two grids on `/map`; after a closure the next one comes at once.
        resolution_m: side of a cell of the grid.
        map_frame: name of the frame of the map.
        known_map: session folder of a finished map on which the robot is looked for; None: there is none.
        limits: of lag and of the smoothed correction.
    """

    out: Path
    config_name: str | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)
    overwrite: bool = False
    rate_hz: float = 20.0
    ahead_s: float = 0.1
    map_every_s: float = 5.0
    resolution_m: float = 0.05
    map_frame: str = "map"
    known_map: Path | None = None
    limits: LiveLimits = field(default_factory=LiveLimits)

    def __post_init__(self) -> None:
        """Refuse a finished map that is missing, damaged or not finished, by a StoreError."""
        if self.known_map is not None:
            require_map(self.known_map)


class RobotNode:
    """Maps what a robot publishes, from its first message until `finish`.

    Attributes:
        ended: set when there is nothing more to wait for: mapping has failed, or `finish` was called.
    """

    def __init__(self, middleware: Middleware, options: NodeOptions) -> None:
        self._ros, self._options = middleware, options
        self.ended = threading.Event()
        self._error: HybridMapError | None = None
        self._incoming: Incoming | None = None
        self._config: Config | None = None
        self._mapper: LiveMapper | None = None
        self._early: list[Sample] = []
        self._feeding = threading.Lock()
        self._missing = ["no topics yet"]
        self._refused = 0
        self._paused = False
        self._newest: tuple[int, float] | None = None  # odometry: stamp, ns, and when it came
        self._process = MappingProcess()  # it loads its libraries while the topics are looked for
        self._starter: threading.Thread | None = None
        self._threads: list[threading.Thread] = []
        self._told_s = 0.0
        self._corrected_ns = 0  # stamp of the last `map -> odom`
        self._map_shown = Shown(options.map_every_s)
        self._graph_shown = Shown(PUBLISH_S)

    def start(self) -> None:
        """Look for the robot's topics, and offer the services; returns at once."""
        given = self._options
        services = Services(self._require_mapper, self._reset, given.out, given.map_frame, given.resolution_m, given.known_map)
        self._ros.offer(services.table)
        pose_type = "geometry_msgs/msg/PoseWithCovarianceStamped"
        self._ros.subscribe(ros.INITIAL_POSE, pose_type, self._guess)
        repeated = {"find": self._find, "map": self._show, "status": self._diagnose, "tf": self._correct}
        for name, do in repeated.items():
            wait_s = 1.0 / self._options.rate_hz if name == "tf" else _LOOK_S
            thread = threading.Thread(target=self._repeat, args=(wait_s, do), name=f"hybridmap-{name}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def pause(self, paused: bool = True) -> None:
        """Leave views out, or take them again; also before the mapper has begun."""
        self._paused = paused
        if self._mapper is not None:
            self._mapper.pause() if paused else self._mapper.resume()

    def finish(self) -> Session:
        """End of the drive: map what still waits, and conclude the session.

        Raises:
            StreamError: nothing was mapped; the message says what was missing.
            HybridMapError: mapping has failed before.
        """
        self.ended.set()
        for thread in self._threads:
            thread.join(_GRID_WAIT_S)
        try:
            return self._concluded()
        finally:
            self._process.close()

    def _concluded(self) -> Session:
        if self._error is None and self._incoming is not None:
            self._incoming.flush()
        if self._starter is not None:
            self._starter.join()
        if self._error is not None:
            raise self._error
        if self._mapper is None:
            raise StreamError(f"{self._ros.source}: nothing was mapped: {'; '.join(self.missing)}")
        return self._mapper.finish()

    @property
    def missing(self) -> list[str]:
        """What the node waits for before it can map, in sentences; empty while it maps."""
        if self._mapper is not None:
            return []
        return self._missing if self._incoming is None else self._incoming.missing or ["the mapper is being started"]

    # ------------------------------------------------------------------ in

    def _find(self) -> None:
        """Choose the topics once all are there, and subscribe; until it maps, say what is missing."""
        if self._incoming is None:
            try:
                chosen = self._choose(self._ros.topics())
                time.sleep(_LOOK_S)
                again = self._choose(self._ros.topics())
            except StreamError as error:
                self._missing = [str(error)]
            else:
                if again.subscriptions == chosen.subscriptions:
                    self._subscribe(chosen)
        else:
            self._incoming.look()
        now_s = time.monotonic()
        if now_s - self._told_s > _TELL_S and self.missing:
            self._told_s = now_s
            for sentence in self.missing:
                self._ros.warn(f"not mapping yet: {sentence}")

    def _choose(self, topics: list[Topic]) -> Incoming:
        options = self._options
        self._config = Config.load(options.config_name, options.overrides)
        found = Incoming(topics, self._config, self._begin, self._ros.source, is_ros1=self._ros.is_ros1)
        if options.config_name is not None:
            return found
        self._config = config_for(found.kind, options.overrides)
        return Incoming(topics, self._config, self._begin, self._ros.source, is_ros1=self._ros.is_ros1)

    def _subscribe(self, incoming: Incoming) -> None:
        self._incoming = incoming
        for topic, msgtype in incoming.subscriptions.items():
            self._ros.inform(f"listening to {topic} ({msgtype})")
            self._ros.subscribe(topic, msgtype, self._taker(incoming, topic))

    def _taker(self, incoming: Incoming, topic: str) -> Callable[[bytes, str | None], None]:
        def take(data: bytes, definition: str | None) -> None:
            try:
                incoming.take(topic, data, definition)
            except StreamError as error:
                self._refused += 1
                self._ros.warn(f"left out: {error}")
            except HybridMapError as error:
                self._fail(error)

        return take

    def _begin(self, rig: Rig) -> Callable[[Sample], None]:
        """Start the mapper, which takes seconds, beside the callbacks; samples are kept until it is there."""
        self._starter = threading.Thread(target=self._start_mapper, args=(rig,), name="hybridmap-start", daemon=True)
        self._starter.start()
        return self._give

    def _start_mapper(self, rig: Rig) -> None:
        assert self._config is not None
        options = self._options
        try:
            mapper = LiveMapper(
                self._config,
                rig,
                options.out,
                name=self._ros.source,
                limits=options.limits,
                overwrite=options.overwrite,
                process=self._process,
            )
            if options.known_map is not None:
                mapper.localise(options.known_map)
        except HybridMapError as error:
            self._fail(error)
            return
        with self._feeding:
            for sample in self._early:
                self._add(mapper, sample)
            self._early.clear()
            self._mapper = mapper
            self.pause(self._paused)
            if self._newest is not None:
                self._show_pose(mapper, self._newest[0])
        self._ros.inform(f"mapping into {options.out}")

    def _give(self, sample: Sample) -> None:
        if isinstance(sample, SelfMotion):
            self._newest = sample.stamp_ns, time.monotonic()
        if self._mapper is None:
            with self._feeding:
                if self._mapper is None:
                    self._early.append(sample)
                    return
        self._add(self._mapper, sample)
        if isinstance(sample, SelfMotion):
            self._show_pose(self._mapper, sample.stamp_ns)

    def _add(self, mapper: LiveMapper, sample: Sample) -> None:
        try:
            mapper.add(sample)
        except StreamError as error:
            self._refused += 1
            self._ros.warn(f"left out: {error}")

    def _guess(self, data: bytes, definition: str | None) -> None:
        """Look for the robot where an operator says that it is on the finished map."""
        try:
            messages = Messages(self._ros.source, self._ros.is_ros1, "its publisher sends another type than it says")
            messages.define(ros.INITIAL_POSE, ros.POSE.msgtype, definition)
            said = messages.decode(RawMessage(ros.INITIAL_POSE, 0, data))
            pose = contents.pose_in(said)
        except StreamError as error:
            self._ros.warn(f"left out: {error}")
            return
        frame = said.header.frame_id.lstrip("/")
        if self._options.known_map is None or self._mapper is None or frame != KNOWN_MAP or not all(map(math.isfinite, pose)):
            wanted = f"finite numbers in the frame {KNOWN_MAP}, while mapping with --map"
            self._ros.warn(f"initialpose: ignored: found {pose.round(2).tolist()} in the frame {frame!r}, expected {wanted}")
            return
        self._mapper.guess(pose)
        self._ros.inform(f"initialpose: looking for the robot at {pose.round(2).tolist()} in {KNOWN_MAP} first")

    # ------------------------------------------------------------------ out

    def _show_pose(self, mapper: LiveMapper, stamp_ns: int) -> None:
        """The robot's pose by the odometry that has just come."""
        pose = mapper.pose_map_robot()
        shown = contents.pose_with_covariance(stamp_ns, self._options.map_frame, pose, mapper.snapshot.covariance)
        self._ros.publish(ros.POSE, shown)

    def _correct(self) -> None:
        """Publish `map -> odom`, smoothed on /tf."""
        mapper, newest, incoming = self._mapper, self._newest, self._incoming
        if mapper is None or newest is None or incoming is None:
            return
        now_s = time.monotonic()
        since_s = min(now_s - newest[1], _LONGEST_S)
        stamp_ns = newest[0] + round((since_s + self._options.ahead_s) * NS_PER_S)
        frames = self._options.map_frame, incoming.frames[0]
        shown = [contents.transform(stamp_ns, *frames, mapper.smoothed_map_odom(now_s).pose_map_odom)]
        there = self._pose_known_map(mapper)
        if there is not None:
            shown.append(contents.transform(stamp_ns, KNOWN_MAP, frames[0], there))
            pose = compose(there, mapper.pose_map_robot())
            self._ros.publish(ros.LOCALIZATION_POSE, contents.pose_with_covariance(newest[0], KNOWN_MAP, pose, None))
        self._ros.publish(ros.RAW_CORRECTION, contents.transform(stamp_ns, *frames, mapper.pose_map_odom))
        if 0 <= self._corrected_ns - stamp_ns < _CLOCK_BACK_S * NS_PER_S:
            return  # odometry is late: what was published is still ahead of it
        self._corrected_ns = stamp_ns
        self._ros.publish(ros.TF, {"transforms": shown})

    def _pose_known_map(self, mapper: LiveMapper) -> Array | None:
        """(3,) pose of this drive's map in the finished one, m and rad; None while unknown."""
        try:
            return mapper.pose_base_map
        except HybridMapError as error:
            self._ros.warn(f"no longer looking for the robot on {self._options.known_map}: {error}")
            mapper.localise(None)
            return None

    def _show(self) -> None:
        """Publish the map where it has changed. A grid of a large map takes seconds."""
        mapper = self._mapper
        if mapper is None:
            return
        snapshot = mapper.snapshot
        if self._graph_shown.is_due(snapshot):
            with self._graph_shown.of(snapshot):
                self._ros.publish(ros.PATH, contents.path(self._options.map_frame, snapshot))
                self._ros.publish(ros.GRAPH, contents.graph(self._options.map_frame, snapshot))
        if self._map_shown.is_due(snapshot):
            with self._map_shown.of(snapshot):
                self._show_map(mapper, snapshot.stamp_ns)

    def _show_map(self, mapper: LiveMapper, stamp_ns: int) -> None:
        try:
            grid = mapper.grid(self._options.resolution_m, timeout_s=_GRID_WAIT_S)
        except ExportError:
            return  # nothing to draw yet
        except (LiveError, StoreError) as error:
            self._ros.warn(f"/map is not shown this time: {error}")
            return
        self._ros.publish(ros.MAP, contents.occupancy(stamp_ns, self._options.map_frame, grid))
        self._ros.publish(ros.MAP_METADATA, contents.metadata(stamp_ns, grid))

    def _diagnose(self) -> None:
        """Publish how the node is doing."""
        mapper, stamp_ns = self._mapper, self._newest[0] if self._newest is not None else time.time_ns()
        if mapper is None:
            self._ros.publish(ros.DIAGNOSTICS, contents.diagnostics(stamp_ns, "hybridmap", None, self.missing))
            return
        report, sentences = mapper.report, mapper.doctor()
        if report.state == "failed":
            self.ended.set()  # `finish` says why
        if self._refused:
            sentences.append(f"{self._refused} messages could not be used")
        losses = {} if self._incoming is None else self._incoming.losses
        sentences += [f"messages left out, {name}: {number}" for name, number in losses.items() if number]
        self._ros.publish(ros.DIAGNOSTICS, contents.diagnostics(stamp_ns, "hybridmap", report, sentences))

    # ------------------------------------------------------------------ threads

    def _repeat(self, wait_s: float, do: Callable[[], None]) -> None:
        while not self.ended.wait(wait_s):
            try:
                do()
            except HybridMapError as error:
                self._fail(error)
            except Exception as error:
                self._fail(RosError(f"{self._ros.source}: {type(error).__name__}: {error}"))
                raise

    def _fail(self, error: HybridMapError) -> None:
        if self._error is None:
            self._error = error
        self.ended.set()

    def _reset(self) -> None:
        mapper = self._require_mapper()
        mapper.reset()
        if self._incoming is not None:
            self._incoming.begin_anew()

    def _require_mapper(self) -> LiveMapper:
        if self._mapper is None:
            raise RosError(f"not mapping yet: {'; '.join(self.missing)}")
        return self._mapper
