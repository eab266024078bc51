"""The whole algorithm on one page: the path integrator tracks self-motion, views close loops, back-ends correct the map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridmap.backends.base import Backend
from hybridmap.backends.ensemble import Ensemble
from hybridmap.calibration.online import OdometryWatch
from hybridmap.config import Config
from hybridmap.edge_book import EdgeBook, Position, Update
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose, inverse
from hybridmap.graph.edges import Edge, Status
from hybridmap.graph.experience_map import ExperienceMap, Node, Novelty
from hybridmap.known_places import KnownPlaces
from hybridmap.metrics import StageClock
from hybridmap.neural.composition import Composition, Integrator
from hybridmap.neural.path_integrator import PathIntegrator, Reanchoring
from hybridmap.second_look import SecondLook, may_part
from hybridmap.streams.base import Rig, Sample, SelfMotion, Velocity
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.rgbd import RgbdFrame
from hybridmap.streams.sensors import rig_of
from hybridmap.streams.synchronise import Ready, Synchroniser
from hybridmap.trajectory import NO_ANCHORS, stamp_ns_from_s
from hybridmap.vision import create_front_end
from hybridmap.vision.base import Belief, DenseFrontEnd, View
from hybridmap.vision.second_opinion import LocalisingFrontEnd, SecondOpinion


class Mapper:
    """Builds an experience map from self-motion and views; usable without any file.

    ```python
    mapper = Mapper(Config.load("laser"), rig)
    mapper.add_odometry(stamp_s, pose_odom_robot)
    update = mapper.add_scan(stamp_s, ranges_m)
    ```

    Attributes:
        map: the nodes and edges so far.
        backends: the back-ends with their latest solutions and failures.
        anchors: poses of frames between nodes; none before `finish`.
        clock: CPU time of each stage.
        known_places: where the map is so dense that the robot is followed on it.
    """

    def __init__(self, config: Config, rig: Rig | None = None, backends: Sequence[str | Backend] | None = None) -> None:
        """Set up all parts.

        Args:
            config: all settings.
            rig: which sensors there are; default: those that the configuration describes.
            backends: names, or unused back-ends, in place of those that the configuration names. The map of the first one,
                the primary, gives the pose of the robot.

        Raises:
            ConfigError: the configuration asks for a sensor that the rig does not have.
            BackendError: a back-end's name is unknown.
        """
        self.config = config
        self.clock = StageClock()
        self.map = ExperienceMap()
        self.book = EdgeBook(self.map, config.edges)
        cells = config.neural.modules > 0
        self.integrator: Integrator = PathIntegrator(config.neural) if cells else Composition(config.neural)
        self.cells = Reanchoring(self.integrator, config.neural.reanchor_weight)
        self.vision = create_front_end(config.vision, rig or rig_of(config.sensors), config.seed, self.clock)
        self.backends = Ensemble(config.backends, self.clock, backends)
        self.second_look = SecondLook(self.map, self.book, self.backends, self.vision, config)
        witness = self.vision.witness if isinstance(self.vision, LocalisingFrontEnd) and may_part(config) else None
        self.second_opinion = SecondOpinion(witness) if witness is not None else None
        self.anchors = NO_ANCHORS
        self._synchroniser = Synchroniser(config.sensors.latency_s, config.sensors.odometry_delay_s or 0.0)
        self.calibration = OdometryWatch(config, self.integrator, self._synchroniser)
        self._novelty = Novelty(config.nodes)
        self.known_places = KnownPlaces(config, self.vision)
        self._position = Position(config.edges, self.backends.primary)
        self._steps_ended = 0

    def add_odometry(self, stamp_s: float, pose_odom_robot: ArrayLike) -> Update | None:
        """Take in a pose (3,) of `base_link` in `odom`, m and rad.

        Returns the newest update, which may be of an earlier sample, or None if no step was possible; `add` returns all. Order
        of samples and errors are as for `add`.
        """
        return _newest(self.add(SelfMotion(stamp_ns_from_s(stamp_s), np.asarray(pose_odom_robot, dtype=np.float64))))

    def add_velocity(self, stamp_s: float, v_m_s: float, omega_rad_s: float) -> Update | None:
        """Take in a forward speed and a turn rate that hold until the next call. Returns as `add_odometry`."""
        return _newest(self.add(Velocity(stamp_ns_from_s(stamp_s), float(v_m_s), float(omega_rad_s))))

    def add_rgbd(self, stamp_s: float, color: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> Update | None:
        """Take in a frame: color (H, W, 3) uint8 RGB, depth (H, W) float32 in m, 0 where invalid.

        A frame waits for odometry at or after its stamp. Until then None is returned; its update comes with a later call.
        """
        return _newest(self.add(RgbdFrame(stamp_ns_from_s(stamp_s), color, depth_m)))

    def add_scan(self, stamp_s: float, ranges_m: ArrayLike) -> Update | None:
        """Take in a scan (B,), m, NaN or Inf where there is no return. It waits for odometry as a frame does (`add_rgbd`)."""
        ranges = np.array(ranges_m, dtype=np.float32)
        ranges[~np.isfinite(ranges)] = np.nan
        return _newest(self.add(LaserScan(stamp_ns_from_s(stamp_s), ranges)))

    def add(self, sample: Sample) -> list[Update]:
        """Take in any sample and do every step that it makes possible, in order of stamp; returns the update of each.

        Give samples in order of stamp over all kinds; `sensors.latency_s` sorts late ones. An observation older than the last
        step, or than the first motion, is left out without an error and counted (`left_out`).

        Raises:
            StreamError: NaN in the motion, motion earlier than the last, an observation earlier than one that waits for
                odometry, or odometry mixed with velocities.
        """
        return [self.step(ready) for ready in self._synchroniser.push(sample)]

    def step(self, ready: Ready) -> Update:
        """One step of the algorithm, called by `add`: path integration, view, new node, loop closure, correction of the map.

        `ready` is the motion since the step before, with the observation at its end, if there is one.
        """
        self._path_integrate(ready)
        view = self._look(ready)
        if view is None and self.vision is not None:
            return self._position.update("no view at this instant")
        new_view = view is not None and view.new_template
        reason = self._novelty.reason(self._position.moved, lambda: self.integrator.place_code, new_view)
        if reason is None:
            return self._position.update("nothing new")
        if view is not None and self._follow():
            return self._position.update("a known place", followed=True)
        with self.clock.stage("graph"):
            odometry = self._position.odometry(self.map.node(len(self.map) - 1).pose_odom) if len(self.map) else None
            node, edges = self._make_node(view)
            if view is not None:
                edges += self._refine_self_motion(node, view, odometry)
                edges += self._close_loops(node)
            self._position.restart()
            self._correct()
        return self._position.update(reason + self.calibration.follow(self.map, self.poses, self.vision), node, edges)

    def finish(self) -> list[Update]:
        """End of the drive: find more loops, solve, measure outlier loops again, and register the frames between nodes.

        Call it once, after the last sample. The last of the returned updates says `end of the drive`, unless no node was made.
        """
        updates = [update for step in self.ending() for update in step]
        self._steps_ended = 0  # loops that are entered afterwards are looked at by another call
        return updates

    def ending(self) -> Iterator[list[Update]]:
        """What `finish` does, in steps; gives the updates of each. If it is left between two steps, another call goes on."""
        steps = (self._flush, self._retime, self._conclude, self._solve_finally, self._look_again, self._measure_between_nodes)
        for step in steps[self._steps_ended :]:
            updates = step() if len(self.map) or not self._steps_ended else []
            self._steps_ended += 1
            yield updates

    @property
    def left_out(self) -> dict[str, int]:
        """Number of samples that were left out so far, by the reason."""
        return dict(self._synchroniser.report.counts)

    @property
    def stamp_ns(self) -> int:
        """Stamp of the newest step, ns; 0 before the first."""
        return self._position.stamp_ns

    @property
    def lost_since(self) -> int | None:
        """First node after the robot was kidnapped or lost track of its motion; None while it is localised on the map."""
        return self.vision.lost_since if self.vision is not None else None

    @property
    def pose_map_robot(self) -> Array:
        """(3,) pose of the robot on the map of the primary back-end, m and rad; before the first node, its pose in `odom`."""
        return self._position.pose_map(self.cells.pose_odom_robot)

    @property
    def pose_map_odom(self) -> Array:
        """(3,) the transform `map -> odom` (REP-105), for the odometry as received."""
        return compose(self.pose_map_robot, inverse(self._position.pose_odom_given))

    def poses(self, backend: str | None = None) -> Array:
        """(N, 3) current poses of all nodes by a back-end (default: the primary), m and rad.

        Raises:
            BackendError: the mapper has no back-end of this name.
        """
        return self.backends.poses(self.map.pose_graph(), backend)

    def belief(self, outliers: Sequence[int] = ()) -> Belief:
        """Poses of the nodes by `edges.gate`, and their covariances, without the edges whose numbers are in `outliers`.

        What the cells showed at a node depends on all loops up to then, outliers too.
        """
        poses_of = (lambda _: self.cells.poses_of_nodes) if self.config.edges.gate == "cells" else self.backends.poses
        return self.book.belief(poses_of, outliers)

    def _correct(self, final: bool = False) -> None:
        """Give the graph to every back-end."""
        graph = self.map.pose_graph()
        (self.backends.finish if final else self.backends.update)(graph)
        self._position.correct({name: self.backends.poses(graph, name) for name in self.backends.names})

    def _conclude(self) -> list[Update]:
        """Let vision propose loops at the end of the drive; anew where the robot was carried to a place that looks alike."""
        updates = self._propose_again()
        while edges := self._carried():
            self._correct()
            updates.append(self._position.update("the robot was carried to a place that looks alike", None, edges))
            updates += self._propose_again()
        return updates

    def _carried(self) -> list[int]:
        """Numbers of the edges that change where the robot was carried to a place that looks alike."""
        if self.second_opinion is None:
            return []
        with self.clock.stage("matching"):
            return self.book.enter(self.second_opinion.ask(self.map.edges, self.backends.rejected, self.belief()))

    def _propose_again(self) -> list[Update]:
        """Let vision decide what is pending and propose loops on the optimised map, until none is accepted."""
        updates: list[Update] = []
        accepted = True
        while accepted and self.vision is not None:
            with self.clock.stage("matching"):
                proposals = self.vision.finish(self.belief())
            if edges := self.book.enter(proposals):
                self._correct()
                updates.append(self._position.update("loops proposed again on the optimised map", None, edges))
            accepted = any(proposal.status is Status.ACCEPTED for proposal in proposals)
        return updates

    def _flush(self) -> list[Update]:
        """Do the steps that still waited for later samples."""
        updates = [self.step(ready) for ready in self._synchroniser.flush()]
        self._position.pose_odom = self.cells.pose_odom_robot
        return updates

    def _solve_finally(self) -> list[Update]:
        self._correct(final=True)
        return []

    def _look_again(self) -> list[Update]:
        """Part the map where the robot was carried unnoticed, and let vision measure again the loops without weight."""
        updates = []
        for done, edges in self.second_look.take(self.belief, self.clock):
            self._correct(final=True)
            updates.append(self._position.update(done, None, edges))
        return updates

    def _measure_between_nodes(self) -> list[Update]:
        """Register the frames between nodes to the final map: the dense trajectory."""
        if isinstance(self.vision, DenseFrontEnd):
            with self.clock.stage("retrace"):
                self.anchors = self.vision.dense_trajectory(replace(self.belief(), poses_map_node=self.poses()))
        return [self._position.update("end of the drive")]

    def _retime(self) -> list[Update]:
        """Measure the odometry of the whole drive again if its clock was off against the views, or its gain by them.

        Not where nodes hang on matched ones: their edges are no motion from node to node.
        """
        if self.config.edges.hanging != "chain":
            return []
        again = self.calibration.finish(self.map, self.vision, self._position.stamp_ns, self._position.pose_odom)
        if again is None:
            return []
        edges = self.book.motion.retime(again.poses_odom[:-1], self.vision)
        self._position.retime(again.poses_odom[-2], again.poses_odom[-1])
        self._correct()
        return [self._position.update(again.why, None, edges)]

    def _path_integrate(self, ready: Ready) -> None:
        with self.clock.stage("neural"):
            self.integrator.step(ready.delta_robot, ready.dt_s)
            self._position.drive(ready, self.cells.pose_odom_robot)
        self.calibration.observe(ready, self._position.pose_odom)

    def _look(self, ready: Ready) -> View | None:
        if self.vision is None or ready.observation is None:
            return None
        with self.clock.stage("profile"):
            return self.vision.observe(ready.observation, self._position.moved if len(self.map) else IDENTITY)

    def _follow(self) -> bool:
        """Find the robot at an older node where there are enough of them, and see it from there; returns whether it was found.

        Costs a search of the shortest paths where there are enough nodes, and a registration as that of a new node.
        """
        solution = self.backends.solutions.get(self.backends.primary)
        if solution is None or len(solution.poses) < len(self.map):  # it failed
            return False
        with self.clock.stage("tracking"):
            stamps_ns, here = self.map.stamps_ns, self.pose_map_robot
            found = self.known_places.find(stamps_ns, solution.poses, self._position, here, self.belief)
        if found is None:
            return False
        self._position.follow(found.node, found.relative)
        self.cells.recalibrate(found.node, found.relative.delta)
        graph = self.map.pose_graph()
        self._position.correct({name: self.backends.poses(graph, name) for name in self.backends.names})
        return True

    def _make_node(self, view: View | None) -> tuple[int, list[int]]:
        """Make a node, join it to the one that the robot was at, and attach the robot to it.

        Where the robot was followed on older nodes, it is joined to the newest one: odometry leads from node to node.
        """
        at, code, spans = self._position, self.integrator.place_code, self._position.followed
        before = len(self.map) - 1 if spans else at.at_node
        moved = between(self.map.node(before).pose_odom, at.pose_odom) if spans else at.moved
        initial = compose(self.map.initial[before], moved) if len(self.map) else at.pose_odom
        node = self.map.add_node(
            Node(at.stamp_ns, at.pose_odom, code, -1 if view is None else view.template, at.travel_m), initial
        )
        self._novelty.remember(code)
        self.cells.remember(node)
        edges = self.book.motion.join(before, node, moved, at.driven, spans) if node > 0 else []
        at.attach(node, at.pose_odom)
        return node, edges

    def _refine_self_motion(self, node: int, view: View, odometry: RelativePose | None) -> list[int]:
        assert self.vision is not None
        with self.clock.stage("tracking"):
            self.vision.add_node(node, view)
            proposals = self.vision.track(node, odometry)
        return self.book.enter(proposals) if self.config.edges.hanging == "chain" else []

    def _close_loops(self, node: int) -> list[int]:
        assert self.vision is not None
        lost_since = self.lost_since
        with self.clock.stage("matching"):
            proposals = self.vision.close(node, self.belief())
        edges = self.book.enter(proposals)
        if closed := [proposal for proposal in proposals if proposal.status is Status.ACCEPTED]:
            found = lost_since is not None and self.lost_since is None
            self._recalibrate(max(closed, key=lambda proposal: proposal.source), lost_since if found else None)
        return edges

    def _recalibrate(self, matched: Edge, lost_since: int | None) -> None:
        """Re-anchor the cells at the matched node (paper eq. 16), and attach the robot to it if so configured (OpenRatSLAM).

        If the robot was lost since a node and is found now, the nodes since then are re-anchored with it.
        """
        assert matched.relative is not None
        pose_odom_matched = compose(self.map.node(matched.source).pose_odom, matched.relative.delta)
        robot = self.cells.pose_odom_robot
        self.cells.recalibrate(matched.target, between(pose_odom_matched, robot))
        self.cells.remember(len(self.map) - 1)
        if self.cells.weight > 0.0:
            self._novelty.recalibrate(self.integrator.place_code)
        if lost_since is not None:
            nodes = range(lost_since, len(self.map))
            self.cells.put_back({node: between(robot, self.map.node(node).pose_odom) for node in nodes})
        if self.config.edges.hanging == "ratslam":
            self._position.attach(matched.target, pose_odom_matched)


def _newest(updates: list[Update]) -> Update | None:
    return updates[-1] if updates else None
