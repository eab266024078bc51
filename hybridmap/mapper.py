"""The whole algorithm on one page: self-motion drives the cells, views close loops, both make the map, back-ends correct it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridmap.backends.base import Backend
from hybridmap.backends.ensemble import Ensemble
from hybridmap.calibration.online import OnlineCalibration
from hybridmap.config import Config
from hybridmap.edge_book import EdgeBook
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose, inverse
from hybridmap.graph.edges import Edge, EdgeKind, Method, Search, Status
from hybridmap.graph.experience_map import ExperienceMap, Node, Novelty
from hybridmap.graph.uncertainty import odometry_covariance, relative_covariances
from hybridmap.metrics import StageClock
from hybridmap.neural.path_integrator import PathIntegrator, Reanchoring
from hybridmap.odometry_model import Gains
from hybridmap.streams.base import Rig, Sample, SelfMotion, Velocity
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame
from hybridmap.streams.sensors import rig_of
from hybridmap.streams.synchronise import Ready, Synchroniser
from hybridmap.trajectory import NO_ANCHORS, NS_PER_S, stamp_ns_from_s
from hybridmap.vision import create_front_end
from hybridmap.vision.base import Belief, RetracingFrontEnd, VerifyingFrontEnd, View


@dataclass(frozen=True, slots=True)
class Update:
    """What one instant did to the map, and why.

    Attributes:
        stamp_ns: of the sample.
        pose_odom_robot: (3,) decoded from the path integrator's activity; `odom` begins where the drive begins.
        pose_map_robot: (3,) by the primary back-end.
        poses_map_robot: the same by every back-end, by name.
        at_node, delta_node_robot: the node that the robot is at (-1 before the first) and its pose (3,) seen from it.
        new_node: the experience made here, None if none was.
        edges: numbers of the edges that are new or changed their verdict.
        reason: why a node was made, or why not.
    """

    stamp_ns: int
    pose_odom_robot: Array
    pose_map_robot: Array
    poses_map_robot: Mapping[str, Array]
    at_node: int
    delta_node_robot: Array
    reason: str
    new_node: int | None = None
    edges: tuple[int, ...] = ()


class Mapper:
    """Builds an experience map from self-motion and views; usable without any file.

    ```python
    mapper = Mapper(Config.load("laser"), rig)
    mapper.add_odometry(stamp_s, pose_odom_robot)
    update = mapper.add_scan(stamp_s, ranges_m)
    ```
    """

    def __init__(self, config: Config, rig: Rig | None = None, backends: Sequence[str | Backend] | None = None) -> None:
        """Set up every stage.

        Args:
            config: settings of all stages.
            rig: which sensors there are; default: those that the configuration describes.
            backends: names, or back-ends in a fresh state, in place of those that the configuration names.

        Raises:
            ConfigError: the configuration asks for a sensor that the rig does not have.
            BackendError: it names an unknown back-end.
        """
        self.config = config
        self.clock = StageClock()
        self.map = ExperienceMap()
        self.book = EdgeBook(self.map, config.edges)
        self.integrator = PathIntegrator(config.neural)
        self.cells = Reanchoring(self.integrator, config.neural.reanchor_weight)
        self.vision = create_front_end(config.vision, rig or rig_of(config.sensors), config.seed, self.clock)
        self.backends = Ensemble(config.backends, self.clock, backends)
        self.calibration = OnlineCalibration(config.calibration, Gains.of(config.neural))
        self.anchors = NO_ANCHORS
        self._synchroniser = Synchroniser(latency_s=config.sensors.latency_s, odometry_delay_s=config.sensors.odometry_delay_s)
        self._novelty = Novelty(config.nodes)
        self._stamp_ns = 0
        self._pose_odom_given: Array = IDENTITY
        self._travel_m = 0.0
        self._at_node = -1
        self._pose_odom_at_node: Array = IDENTITY
        self._pose_map_at_node: dict[str, Array] = {}
        self._since_node = (0.0, 0.0)

    def add_odometry(self, stamp_s: float, pose_odom_robot: ArrayLike) -> Update | None:
        """Take in a pose (3,) of `base_link` in `odom`; returns the newest update, None while nothing is ready."""
        return _newest(self.add(SelfMotion(stamp_ns_from_s(stamp_s), np.asarray(pose_odom_robot, dtype=np.float64))))

    def add_velocity(self, stamp_s: float, v_m_s: float, omega_rad_s: float) -> Update | None:
        """Take in a forward speed and a turn rate that hold until the next call."""
        return _newest(self.add(Velocity(stamp_ns_from_s(stamp_s), float(v_m_s), float(omega_rad_s))))

    def add_rgbd(self, stamp_s: float, color: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> Update | None:
        """Take in a frame: color (H, W, 3) uint8 RGB, depth (H, W) float32 in m, 0 where invalid.

        A frame waits for odometry at or after its stamp: the update may come with a later call (None until then).
        """
        return _newest(self.add(RgbdFrame(stamp_ns_from_s(stamp_s), color, depth_m)))

    def add_scan(self, stamp_s: float, ranges_m: ArrayLike) -> Update | None:
        """Take in a scan (B,), m, NaN or Inf where there is no return; waits for odometry as `add_rgbd` does."""
        ranges = np.array(ranges_m, dtype=np.float32)
        ranges[~np.isfinite(ranges)] = np.nan
        return _newest(self.add(LaserScan(stamp_ns_from_s(stamp_s), ranges)))

    def add(self, sample: Sample) -> list[Update]:
        """Take in any sample and do every step that it makes possible, in order of stamp.

        Raises:
            StreamError: NaN in the motion, or a stamp that goes back.
        """
        return [self.step(ready) for ready in self._synchroniser.push(sample)]

    def step(self, ready: Ready) -> Update:
        """One instant through the paper's figure: cells, view, experience, closure, correction."""
        pose_odom = self._path_integrate(ready)
        moved = between(self._pose_odom_at_node, pose_odom)
        view = self._look(ready, moved)
        if view is None and self.vision is not None:
            return self._update(pose_odom, "no view at this instant")
        reason = self._novelty.reason(moved, lambda: self.integrator.place_code, view is not None and view.new_template)
        if reason is None:
            return self._update(pose_odom, "nothing new")
        with self.clock.stage("graph"):
            node = self._make_node(pose_odom, moved, view)
            edges = self._join_to_chain(node)
            if view is not None:
                edges += self._refine_self_motion(node, view)
                edges += self._close_loops(node)
            self._since_node = (0.0, 0.0)
            self._correct()
        return self._update(pose_odom, reason + self._calibrate(), node, edges)

    def finish(self) -> list[Update]:
        """End of the drive: settle what waits, propose loops again on the optimised map, let every back-end finish."""
        updates = [self.step(ready) for ready in self._synchroniser.flush()]
        pose_odom = self.cells.pose_odom_robot
        while self.vision is not None and len(self.map):
            with self.clock.stage("matching"):
                proposals = self.vision.finish(self.belief())
            edges = self.book.enter(proposals)
            if not edges:
                break
            self._correct()
            updates.append(self._update(pose_odom, "loops proposed again on the optimised map", None, edges))
            if not any(proposal.status is Status.ACCEPTED for proposal in proposals):
                break
        if len(self.map):
            self._correct(final=True)
            if edges := self._verify_again():
                self._correct(final=True)
                updates.append(self._update(pose_odom, "loops without weight measured again", None, edges))
            self._retrace()
            updates.append(self._update(pose_odom, "end of the drive"))
        return updates

    @property
    def lost_since(self) -> int | None:
        """First node from which on the robot may be elsewhere than the map has it: the chain broke there, no loop since."""
        return self.vision.lost_since if self.vision is not None else None

    @property
    def pose_map_robot(self) -> Array:
        """(3,) where the robot is, by the primary back-end."""
        return self._update(self.cells.pose_odom_robot, "").pose_map_robot

    @property
    def pose_map_odom(self) -> Array:
        """(3,) the correction `map -> odom` (REP-105) for the odometry as it came in."""
        return compose(self.pose_map_robot, inverse(self._pose_odom_given))

    def poses(self, backend: str | None = None) -> Array:
        """(N, 3) current poses of all nodes by a back-end (default: the primary)."""
        return self.backends.poses(self.map.pose_graph(), backend)

    def belief(self, doubted: Sequence[int] = ()) -> Belief:
        """What the map believes, for the gating of loop closures; edges of the numbers `doubted` hold nothing together."""
        own = self.config.edges.gate == "odometry"
        graph = self.map.pose_graph().only(EdgeKind.ODOMETRY) if own else self.map.pose_graph()
        graph = graph.with_edges(~np.isin(graph.edge_ids, doubted)) if len(doubted) else graph
        return Belief(
            poses_map_node=graph.initial if own else self.backends.poses(graph),
            stamps_s=np.array([node.stamp_ns for node in self.map.nodes]) / NS_PER_S,
            travel_m=np.array([node.travel_m for node in self.map.nodes]),
            covariance_from=cache(lambda node: relative_covariances(graph, node)),
        )

    def _correct(self, final: bool = False) -> None:
        """Give the graph to every back-end."""
        graph = self.map.pose_graph()
        if final:
            self.backends.finish(graph)
        else:
            self.backends.update(graph)
        self._pose_map_at_node = {name: self.backends.poses(graph, name)[self._at_node] for name in self.backends.names}

    def _verify_again(self) -> list[int]:
        """Have the loops that the primary back-end gave no weight measured again, from where they lie on its map."""
        solution = self.backends.solutions.get(self.backends.primary)
        if solution is None or not isinstance(self.vision, VerifyingFrontEnd) or self.config.edges.gate == "odometry":
            return []
        doubted = self.book.without_weight(solution.report)
        with self.clock.stage("matching"):
            proposals = self.vision.verify(doubted, self.belief(solution.report.rejected_edge_ids)) if doubted else []
        return self.book.enter_again(proposals)

    def _retrace(self) -> None:
        """Once the map is final, measure on it where the robot was between nodes."""
        if isinstance(self.vision, RetracingFrontEnd):
            with self.clock.stage("retrace"):
                self.anchors = self.vision.retrace(replace(self.belief(), poses_map_node=self.poses()))

    def _calibrate(self) -> str:
        """Let the gains follow the map, where the map is sure; returns what to add to the reason."""
        change = self.calibration.follow(self._stamp_ns, self.map.pose_graph, self.poses)
        if change is None:
            return ""
        self.integrator.gains = change.gains
        return f"; {change}"

    def _path_integrate(self, ready: Ready) -> Array:
        self.calibration.observe(ready.stamp_ns, ready.delta_robot)
        with self.clock.stage("neural"):
            self.integrator.step(ready.delta_robot, ready.dt_s)
            pose_odom = self.cells.pose_odom_robot
        self._stamp_ns, self._pose_odom_given = ready.stamp_ns, ready.pose_odom_robot
        travel_m, turn_rad = float(np.hypot(ready.delta_robot[0], ready.delta_robot[1])), abs(float(ready.delta_robot[2]))
        self._travel_m += travel_m
        self._since_node = (self._since_node[0] + travel_m, self._since_node[1] + turn_rad)
        return pose_odom

    def _look(self, ready: Ready, moved: Array) -> View | None:
        if self.vision is None or ready.observation is None:
            return None
        with self.clock.stage("profile"):
            return self.vision.observe(ready.observation, moved if len(self.map) else IDENTITY)

    def _make_node(self, pose_odom: Array, moved: Array, view: View | None) -> int:
        code = self.integrator.place_code
        template = view.template if view is not None else -1
        initial = compose(self.map.initial[self._at_node], moved) if len(self.map) else pose_odom
        node = self.map.add_node(Node(self._stamp_ns, pose_odom, code, template, self._travel_m), initial)
        self._novelty.remember(code)
        self.cells.remember(node)
        return node

    def _join_to_chain(self, node: int) -> list[int]:
        """Join the new node to the one that the robot was at; from now on the robot is at the new one."""
        edges = []
        if node > 0:
            relative = self._odometry_from(self._pose_odom_at_node, node)
            edge = Edge.decided(self._at_node, node, EdgeKind.ODOMETRY, relative, method=Method.ODOMETRY, search=Search.CHAIN)
            edges.append(self.map.add_edge(edge))
        self._at_node, self._pose_odom_at_node = node, self.map.node(node).pose_odom
        return edges

    def _odometry_from(self, pose_odom_before: Array, node: int) -> RelativePose:
        covariance = odometry_covariance(self.config.edges, *self._since_node)
        return RelativePose(between(pose_odom_before, self.map.node(node).pose_odom), covariance)

    def _refine_self_motion(self, node: int, view: View) -> list[int]:
        assert self.vision is not None
        with self.clock.stage("tracking"):
            self.vision.add_node(node, view)
            odometry = self._odometry_from(self.map.node(node - 1).pose_odom, node) if node > 0 else None
            proposals = self.vision.track(node, odometry)
        return self.book.enter(proposals) if self.config.edges.hanging == "chain" else []

    def _close_loops(self, node: int) -> list[int]:
        assert self.vision is not None
        with self.clock.stage("matching"):
            proposals = self.vision.close(node, self.belief())
        edges = self.book.enter(proposals)
        closed = [proposal for proposal in proposals if proposal.status is Status.ACCEPTED]
        if closed:
            self._recalibrate(max(closed, key=lambda proposal: proposal.source))
        return edges

    def _recalibrate(self, matched: Edge) -> None:
        """Bring the cells back to the matched node, which lies in `odom` where the match has it, and hang the robot on it.

        Both as configured: `neural.reanchor_weight` (paper eq. 16) and `edges.hanging: ratslam` (OpenRatSLAM).
        """
        assert matched.relative is not None
        pose_odom_matched = compose(self.map.node(matched.source).pose_odom, matched.relative.delta)
        self.cells.recalibrate(matched.target, between(pose_odom_matched, self.cells.pose_odom_robot))
        if self.config.edges.hanging == "ratslam":
            self._at_node, self._pose_odom_at_node = matched.target, pose_odom_matched

    def _update(self, pose_odom: Array, reason: str, node: int | None = None, edges: list[int] | None = None) -> Update:
        moved = between(self._pose_odom_at_node, pose_odom)
        on_map = {name: compose(pose, moved) for name, pose in self._pose_map_at_node.items()}
        primary = on_map.get(self.backends.primary, pose_odom)
        return Update(self._stamp_ns, pose_odom, primary, on_map, self._at_node, moved, reason, node, tuple(edges or ()))


def _newest(updates: list[Update]) -> Update | None:
    return updates[-1] if updates else None
