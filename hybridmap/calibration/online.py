"""Calibration while driving: the clock of the odometry, and its gains once the map shows with certainty that they are wrong."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.calibration.clock import SensorClock
from hybridmap.calibration.estimate import Estimate
from hybridmap.calibration.legs import Motion
from hybridmap.calibration.regression import Sighting, regress
from hybridmap.config import Config
from hybridmap.errors import EvaluationError
from hybridmap.geometry import Array
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.neural.path_integrator import PathIntegrator
from hybridmap.odometry_model import Gains
from hybridmap.streams.synchronise import Ready, Synchroniser

FIRST_M, EVERY_M = 50.0, 25.0
"""Travel before the first estimate and between two, m: legs between closures are then long enough to tell gains from noise."""
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


class OnlineCalibration:
    """Collects raw odometry, and from time to time estimates its gains from the map. Does nothing if it is switched off.

    Odometry edges that exist do not change; new gains apply to the rest of the drive.
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


class OdometryWatch:
    """What is learnt about the odometry while driving, and put to use at once: its clock, and its gains if so configured.

    Attributes:
        clock: the offset between views and odometry.
    """

    def __init__(self, config: Config, integrator: PathIntegrator, synchroniser: Synchroniser) -> None:
        """Start before the drive; gains go to the integrator, the offset to the synchroniser."""
        self.clock = SensorClock(config.sensors)
        self._gains = OnlineCalibration(Gains.of(config.neural)) if config.calibration.online else None
        self._integrator, self._synchroniser = integrator, synchroniser

    @property
    def changes(self) -> list[GainChange]:
        """The changes of the gains so far."""
        return [] if self._gains is None else self._gains.changes

    def observe(self, ready: Ready, pose_odom: Array) -> None:
        """Take note of a step of raw odometry, and of the pose (3,) in `odom` after it."""
        self.clock.observe(ready, pose_odom)
        if self._gains is not None:
            self._gains.observe(ready.stamp_ns, ready.delta_robot)

    def follow(self, experiences: ExperienceMap, poses: Callable[[], Array]) -> str:
        """Take note of a new node, and correct what the map shows to be wrong; returns what was corrected, in words.

        Args:
            experiences: the map with the new node.
            poses: called for the poses (N, 3) of all nodes, only if an estimate of the gains is due.
        """
        said = ""
        if (late_s := self.clock.follow(experiences)) is not None:
            self._synchroniser.retime(late_s)
            said = f"; {self.clock.offset}"
        stamp_ns = experiences.node(len(experiences) - 1).stamp_ns
        change = self._gains.follow(stamp_ns, experiences.pose_graph, poses) if self._gains is not None else None
        if change is None:
            return said
        self._integrator.gains = change.gains
        return f"{said}; {change}"
