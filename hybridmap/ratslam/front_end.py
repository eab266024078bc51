"""The front-end of RatSLAM: which experience each frame belongs to, by view cells and pose cells; for camera and laser."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, inverse
from hybridmap.graph.edges import Edge, EdgeKind, Method, Proposer, Search, at_most
from hybridmap.metrics import StageClock
from hybridmap.neural.pose_cells import CELL_M, CELL_RAD, PoseCells
from hybridmap.ratslam.experiences import Decision, Experience, Experiences
from hybridmap.streams.base import Observation, Rig
from hybridmap.vision.base import HELD_IMAGES, Belief, View, held
from hybridmap.vision.scanline.retina import Retina, retina_of
from hybridmap.vision.templates import THRESHOLD, Recognition, ViewTemplates

SIGMA_M, SIGMA_RAD = 0.5 * CELL_M, 0.5 * CELL_RAD
"""Standard deviations of a match, for back-ends that weigh edges: an experience is a place to half a cell."""


class RatslamFrontEnd:
    """View cells and pose cells decide which experience the robot is in; implements `FrontEnd`.

    A frame whose pair of view cell and place on the pose cells is unlike that of the current experience becomes a node, under
    the node rule `views`. If an earlier experience has the pair, the node is joined to that one: it is the same place, at the
    heading that the shift of the profile tells. The way there is that of the wheels. Nothing is verified or registered.

    Args:
        config: settings of the visual side.
        retina: the sensor.
    """

    def __init__(self, config: VisionConfig, retina: Retina) -> None:
        matching, profile = config.matching, config.profile
        self._threshold = THRESHOLD if matching.c_t is None else matching.c_t
        self._reach_cells = config.closing.gate_sigmas
        self._views = ViewTemplates(profile.max_shift, matching.mu_r, matching.mu_d, self._threshold, stable_frames=1)
        self._retina = retina
        self._pose_cells = PoseCells()
        self._experiences = Experiences(self._reach_cells)
        self._profiles: list[NDArray[np.float32]] = []
        self._frames: deque[tuple[int, Observation]] = deque(maxlen=HELD_IMAGES)
        self._delta = IDENTITY
        self._seen: tuple[Observation, Recognition, Array, Decision] | None = None

    def observe(self, frame: Observation, delta_node_robot: Array) -> View:
        """Take in a frame: the view cell that it activates, and one iteration of the pose cells; see `FrontEnd.observe`."""
        profile = self._retina.glance(frame).profile
        seen = self._views.recognise(profile)
        motion, self._delta = between(self._delta, delta_node_robot), delta_node_robot
        place = self._pose_cells.step(seen.template, motion, -self._retina.yaw_rad(seen.shift))
        decision = self._experiences.decide(seen.template, place)
        self._seen = frame, seen, place, decision
        return View(frame.stamp_ns, profile, seen.template, decision.changed)

    def add_node(self, node: int, view: View) -> None:
        """Make a node of the frame that was observed last, and take up its experience; see `FrontEnd.add_node`.

        Raises:
            ValueError: no frame was observed yet, or `node` is not the next number.
        """
        if self._seen is None or node != len(self._profiles):
            raise ValueError(f"vision: found node {node}, expected node {len(self._profiles)} after a frame was observed")
        frame, seen, place, decision = self._seen
        self._profiles.append(view.profile)
        self._frames.append((node, frame))
        self._delta = IDENTITY
        if decision.changed:
            self._experiences.enter(decision.again or Experience(node, seen.template, place))

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        """No edges: nothing is registered; see `FrontEnd.track`."""
        del node, odometry
        return []

    def close(self, node: int, belief: Belief) -> list[Edge]:
        """Join the new node to the earlier experience that it is, if it is one; see `FrontEnd.close`."""
        del belief
        assert self._seen is not None
        _, seen, _, decision = self._seen
        if decision.again is None:
            return []
        older = np.array([0.0, 0.0, self._retina.yaw_rad(seen.shift)])
        self._delta = inverse(older)
        checks = (
            at_most("difference of the views", seen.difference, self._threshold, "vision.matching.c_t"),
            at_most("distance on the pose cells, cells", decision.apart_cells, self._reach_cells, "vision.closing.gate_sigmas"),
        )
        covariance = np.diag([SIGMA_M, SIGMA_M, SIGMA_RAD]) ** 2
        relative = RelativePose(older, covariance)
        return [
            Edge.decided(
                node,
                decision.again.node,
                EdgeKind.LOOP,
                relative,
                checks,
                method=Method.PROFILE,
                search=Search.GATE,
                proposed_by=Proposer.PROFILE,
                shift=seen.shift,
            )
        ]

    def finish(self, belief: Belief) -> list[Edge]:
        """No edges: nothing is pending; see `FrontEnd.finish`."""
        del belief
        return []

    @property
    def lost_since(self) -> int | None:
        """None: the front-end never takes the robot for lost."""

    def keyframe(self, node: int) -> dict[str, NDArray[np.generic]]:
        """`profile` (bands, width) float32 and the frame as the sensor stores it.

        Raises:
            StreamError: the node's frame is no longer held (see `HELD_IMAGES`); the map file has it.
        """
        return {"profile": self._profiles[node], **self._retina.compact(held(self._frames, node))}


def create(config: VisionConfig, rig: Rig, seed: int, clock: StageClock) -> RatslamFrontEnd:
    """Make RatSLAM's front-end for the sensor that `vision.sensor` names, or the first of the rig that it can use.

    Raises:
        ConfigError: the rig has neither laser nor camera of that name.
    """
    del seed, clock
    return RatslamFrontEnd(config, retina_of(config, rig))
