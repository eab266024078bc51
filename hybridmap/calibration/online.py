"""Calibration while driving: the clock of the odometry, and its gains once the map shows with certainty that they are wrong."""

from __future__ import annotations

import logging
import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.calibration.clock import ClockOffset, Headings, Turns, offset_of
from hybridmap.calibration.estimate import SIGNIFICANT_SIGMAS, Estimate
from hybridmap.calibration.legs import Motion
from hybridmap.calibration.regression import Sighting, regress
from hybridmap.config import Config
from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import EvaluationError
from hybridmap.geometry import Array, between, compose, interpolate
from hybridmap.graph.edges import EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.neural.composition import Integrator
from hybridmap.odometry_model import Gains
from hybridmap.streams.synchronise import Ready, Synchroniser
from hybridmap.trajectory import NS_PER_S
from hybridmap.vision.base import FrontEnd, GaugingFrontEnd

FIRST_M, EVERY_M = 50.0, 25.0
"""Travel before the first estimate of the gains and between two, m: legs between closures are then long enough to tell gains
from noise."""
CLOCK_FIRST_M, CLOCK_AGAIN = 20.0, 1.1
"""Path length before the first estimate of the clock, m, and the factor from one estimate to the next. On a shorter drive a
slip in one of few turns looks like an offset. With the factor the cost of all estimates is linear in the drive."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class GainChange:
    """New gains of odometry, in use from a stamp on.

    Attributes:
        stamp_ns: stamp of the last odometry step with the old gains.
        gains: the new gains.
        estimate: the estimate that led to them.
    """

    stamp_ns: int
    gains: Gains
    estimate: Estimate

    @property
    def row(self) -> list[float]:
        """The row in the map file: stamp_ns, gain, turn gain, heading bias."""
        return [self.stamp_ns, *self.gains.to_array().tolist()]

    def __str__(self) -> str:
        named = zip(("gain", "turn gain", "heading bias"), self.gains.to_array(), self.estimate.sigmas, strict=False)
        told = (f"{name} {value:.4f} +- {sigma:.4f}" for name, value, sigma in named if np.isfinite(sigma))
        return "odometry gains changed: " + ", ".join(told)


class SensorClock:
    """Collects the odometry of a drive, and estimates from its registrations how late the views are stamped.

    The estimate is due after `CLOCK_FIRST_M` metres and then whenever the drive has grown by a tenth, until it is known; and
    once more from the whole drive at its end.

    Attributes:
        offset: the newest estimate.
    """

    def __init__(self, sensors: SensorsConfig) -> None:
        """Start before the drive; an offset that the settings give is taken as it is, and only the rest is estimated."""
        self.offset = ClockOffset()
        self._given = sensors.odometry_delay_s is not None
        self._stamps_ns, self._poses = array("q"), array("d")
        self._due_m = math.inf if self._given else CLOCK_FIRST_M

    def observe(self, ready: Ready, pose_odom: Array) -> None:
        """Take note of a step of self-motion and of the pose (3,) in `odom` after it; a view between two steps is ignored."""
        if ready.odometry_ns is not None and (not self._stamps_ns or ready.odometry_ns > self._stamps_ns[-1]):
            self._stamps_ns.append(ready.odometry_ns)
            self._poses.extend(pose_odom.tolist())

    def follow(self, experiences: ExperienceMap) -> float | None:
        """Take note of a new node, the newest of the map.

        Returns:
            The offset to correct from now on, s, once: at the node where it becomes known, if it matters. Else None.
        """
        travel_m = experiences.node(len(experiences) - 1).travel_m
        if travel_m < self._due_m:
            return None
        self.offset = self._estimated(experiences)
        self._due_m = math.inf if self.offset.known else CLOCK_AGAIN * travel_m
        if not self.offset.matters:
            return None
        self.offset = replace(self.offset, used_s=self.offset.offset_s)
        _logger.info("%s", self.offset)
        return self.offset.used_s

    def finish(self, experiences: ExperienceMap) -> bool:
        """Estimate the offset from the whole drive, at its end.

        Returns:
            Whether all odometry of the drive must be computed again, by `poses_at`, with the offset that is now in
            `offset.used_s`; never if the settings give the delay.
        """
        before, self.offset = self.offset, self._estimated(experiences, wide=True)
        if not self.offset.known and before.known:
            self.offset = before
        corrected = not self._given and (self.offset.matters or before.used_s != 0.0)
        if corrected:
            self.offset = replace(self.offset, used_s=self.offset.offset_s)
        return corrected

    def poses_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Poses (N, 3) in `odom` at stamps (N,) of views, by corrected odometry; held before its first and after its last."""
        times, poses = self._track()
        wanted = np.clip(stamps_ns - round(self.offset.used_s * NS_PER_S), times[0], times[-1])
        after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
        share = (wanted - times[after - 1]) / (times[after] - times[after - 1])
        return interpolate(poses[after - 1], poses[after], share)

    def poses_again(self, stamps_ns: NDArray[np.int64], driven: Array) -> Array:
        """As `poses_at`, in place of the poses (N, 3) that were driven with."""
        del driven
        return self.poses_at(stamps_ns)

    def _estimated(self, experiences: ExperienceMap, *, wide: bool = False) -> ClockOffset:
        times, poses = self._track()
        if len(times) < 2:
            return ClockOffset()
        way = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        stamps_s = (times - times[0]) / NS_PER_S
        headings = Headings(stamps_s, np.unwrap(poses[:, 2]), np.concatenate([[0.0], np.cumsum(way)]))
        travel_m = float(headings.travel_m[-1])
        found = (
            offset_of(headings, _turns(experiences, int(times[0])), wide=wide) if travel_m >= CLOCK_FIRST_M else ClockOffset()
        )
        return replace(found, travel_m=travel_m)

    def _track(self) -> tuple[NDArray[np.int64], Array]:
        times = np.array(self._stamps_ns, dtype=np.int64)
        return times, np.array(self._poses, dtype=np.float64).reshape(-1, 3)


def _turns(experiences: ExperienceMap, start_ns: int) -> Turns:
    """The accepted registrations of consecutive nodes; times since `start_ns`."""
    rows = []
    for edge in experiences.edges:
        registered = edge.kind is EdgeKind.REGISTRATION and edge.status is Status.ACCEPTED and edge.target == edge.source + 1
        if registered and edge.relative is not None:
            ends_ns = [experiences.node(end).stamp_ns - start_ns for end in (edge.source, edge.target)]
            rows.append([*ends_ns, edge.relative.delta[2], edge.relative.covariance[2, 2]])
    first, last, turn, variance = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    return Turns(first / NS_PER_S, last / NS_PER_S, turn, np.sqrt(variance))


class OnlineCalibration:
    """Collects raw odometry, and from time to time estimates its gains from the map.

    Odometry edges that exist do not change; new gains apply to the rest of the drive.

    Attributes:
        changes: the changes of the gains so far, in order.
    """

    def __init__(self, gains: Gains) -> None:
        """Start with the gains that the path integrator uses."""
        self.changes: list[GainChange] = []
        self._in_use = gains
        self._stamps_ns: list[int] = []
        self._steps: list[Array] = []
        self._node_stamps_ns: list[int] = []
        self._travel_m = 0.0
        self._due_m = FIRST_M

    def observe(self, stamp_ns: int, delta_robot: Array) -> None:
        """Add a raw odometry step (3,), m and rad, that ends at a stamp; a second step with the same stamp must be zero."""
        if self._stamps_ns and stamp_ns <= self._stamps_ns[-1]:
            return
        if self._stamps_ns:
            self._steps.append(delta_robot)
            self._travel_m += float(np.hypot(delta_robot[0], delta_robot[1]))
        self._stamps_ns.append(stamp_ns)

    def follow(self, stamp_ns: int, graph: Callable[[], PoseGraph], poses: Callable[[], Array]) -> GainChange | None:
        """Take note of a new node; returns the change of gains to apply, None if there is none.

        From then on the new gains count as those in use.

        Args:
            stamp_ns: stamp of the new node.
            graph: called for nodes and accepted edges, with the new node, only if the next estimate is due.
            poses: called for the poses (N, 3) of all nodes on the map, only if the next estimate is due.
        """
        self._node_stamps_ns.append(stamp_ns)
        if self._travel_m < self._due_m or not np.any(graph().kinds != EdgeKind.ODOMETRY):
            return None
        self._due_m = self._travel_m + EVERY_M
        motion = Motion(np.array(self._stamps_ns, dtype=np.int64), np.array(self._steps))
        stamps: NDArray[np.int64] = np.array(self._node_stamps_ns, dtype=np.int64)
        try:
            estimate = regress([Sighting(motion, stamps, poses())])
        except EvaluationError as error:
            _logger.info("%s", error)
            return None
        if not estimate.differs(self._in_use):
            return None
        self._in_use = estimate.kept(self._in_use)
        change = GainChange(stamp_ns, self._in_use, estimate)
        self.changes.append(change)
        _logger.warning("%s", change)
        return change


@dataclass(frozen=True, slots=True)
class Remeasured:
    """The odometry of a whole drive, measured again.

    Attributes:
        poses_odom: (N + 1, 3) poses of the N nodes and of the robot at the end, in `odom`.
        poses_at: (stamps (T,), ns, poses (T, 3) in `odom` at these as they were while driving) -> new poses (T, 3).
        gains: the gains of the whole odometry; None: those of each time while driving, only its clock was corrected.
        why: what was corrected, in words.
    """

    poses_odom: Array
    poses_at: Callable[[NDArray[np.int64], Array], Array]
    gains: Gains | None
    why: str


@dataclass(frozen=True, slots=True)
class _Rescaled:
    """Odometry from N nodes on, scaled: the stamps, poses before and after, and scales (N, 3) of the nodes."""

    stamps_ns: NDArray[np.int64]
    before: Array
    after: Array
    scale: Array

    def poses_at(self, stamps: NDArray[np.int64], driven: Array) -> Array:
        """New poses (T, 3) for those that were driven with at stamps (T,)."""
        node = np.clip(np.searchsorted(self.stamps_ns, stamps, side="right") - 1, 0, None)
        return compose(self.after[node], between(self.before[node], driven) * self.scale[node])


class OdometryWatch:
    """What is learnt about the odometry while driving, and put to use at once: its clock, and its gains if so configured.

    Attributes:
        clock: the offset between views and odometry.
        remeasured: the odometry of the whole drive as `finish` measured it again; None if it did not.
    """

    def __init__(self, config: Config, integrator: Integrator, synchroniser: Synchroniser) -> None:
        """Start before the drive; gains go to the integrator, the offset to the synchroniser."""
        self.remeasured: Remeasured | None = None
        self.clock = SensorClock(config.sensors)
        self._gains = OnlineCalibration(Gains.of(config.neural)) if config.calibration.online else None
        self._seen: list[GainChange] = []
        self._integrator, self._synchroniser = integrator, synchroniser

    @property
    def changes(self) -> list[GainChange]:
        """The changes of the gains so far."""
        return self._seen or ([] if self._gains is None else self._gains.changes)

    def observe(self, ready: Ready, pose_odom: Array) -> None:
        """Take note of a step of raw odometry, and of the pose (3,) in `odom` after it."""
        self.clock.observe(ready, pose_odom)
        if self._gains is not None:
            self._gains.observe(ready.stamp_ns, ready.delta_robot)

    def follow(self, experiences: ExperienceMap, poses: Callable[[], Array], vision: FrontEnd | None = None) -> str:
        """Take note of a new node, and correct what the map, or the views, show to be wrong.

        Args:
            experiences: the map with the new node.
            poses: called for the poses (N, 3) of all nodes, only if an estimate of the gains is due.
            vision: asked for the gain of the wheels instead of the map, if it measures that.

        Returns:
            What was corrected, in words that begin with "; ", to be added to a reason; empty string if nothing was.
        """
        said = ""
        if (late_s := self.clock.follow(experiences)) is not None:
            self._synchroniser.retime(late_s)
            said = f"; {self.clock.offset}"
        if self._gains is None:
            return said
        stamp_ns = experiences.node(len(experiences) - 1).stamp_ns
        if isinstance(vision, GaugingFrontEnd):
            change = self._gauged(stamp_ns, vision)
        else:
            change = self._gains.follow(stamp_ns, experiences.pose_graph, poses)
        if change is None:
            return said
        self._integrator.gains = change.gains
        return f"{said}; {change}"

    def finish(self, experiences: ExperienceMap, vision: FrontEnd | None, stamp_ns: int, pose_odom: Array) -> Remeasured | None:
        """At the end of the drive, measure all of its odometry again if its clock was off, else with the gain by the views.

        Args:
            experiences: the map.
            vision: see `follow`.
            stamp_ns, pose_odom: where the robot is now: stamp and pose (3,) in `odom`.

        Returns:
            None if nothing has to be corrected.
        """
        stamps_ns = np.array([*(node.stamp_ns for node in experiences.nodes), stamp_ns], dtype=np.int64)
        poses = np.array([*(node.pose_odom for node in experiences.nodes), pose_odom])
        if self.clock.finish(experiences):
            clock = self.clock
            self.remeasured = Remeasured(clock.poses_at(stamps_ns), clock.poses_again, None, str(clock.offset))
        elif self._gains is not None and isinstance(vision, GaugingFrontEnd):
            self.remeasured = self._regauged(stamps_ns, poses, vision)
        return self.remeasured

    def _regauged(self, stamps_ns: NDArray[np.int64], poses: Array, vision: GaugingFrontEnd) -> Remeasured | None:
        """The odometry of the whole drive with the gain by the views, which was in use for a part of it at most."""
        driven_with = list(self._seen)
        self._gauged(int(stamps_ns[-1]), vision)
        if not self._seen:
            return None
        gains = np.array([self._integrator.config.gain, *(change.gains.gain for change in driven_with)])
        since_ns = np.array([change.stamp_ns for change in driven_with], dtype=np.int64)
        factor = self._seen[-1].gains.gain / gains[np.searchsorted(since_ns, stamps_ns[:-1], side="right")]
        scale = np.column_stack([factor, factor, np.ones(len(factor))])
        after = _chained(poses[0], between(poses[:-1], poses[1:]) * scale)
        rescaled = _Rescaled(stamps_ns[:-1], poses, after, scale)
        return Remeasured(after, rescaled.poses_at, self._seen[-1].gains, str(self._seen[-1]))

    def _gauged(self, stamp_ns: int, vision: GaugingFrontEnd) -> GainChange | None:
        """The gain by the views, if it differs from that in use: a change to apply. One that no robot has is left alone."""
        seen = vision.gain
        if seen is None or abs(seen.gain - 1.0) <= SIGNIFICANT_SIGMAS * seen.sigma:
            return None
        in_use = self._integrator.gains if not self._seen else self._seen[-1].gains
        gain = seen.gain * in_use.gain
        covariance = np.diag([(seen.sigma * in_use.gain) ** 2, np.inf, np.inf, np.inf])
        try:
            gains = replace(in_use, gain=gain).checked("gain by the views")
        except EvaluationError as error:
            _logger.info("%s", error)
            return None
        estimate = Estimate(gains, 0.0, covariance, 0.0, float(seen.steps), 0.0, 1.0, 0.0)
        self._seen.append(GainChange(stamp_ns, gains, estimate))
        vision.rescale(seen.gain)
        _logger.info("%s", self._seen[-1])
        return self._seen[-1]


def _chained(first: Array, steps: Array) -> Array:
    """Poses (N + 1, 3) of steps (N, 3) from the first pose (3,) on."""
    poses = [first]
    for step in steps:
        poses.append(compose(poses[-1], step))
    return np.array(poses)
