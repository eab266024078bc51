"""The scanline front-end: loops by the paper's means alone, for camera and laser. It registers nothing."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.geometry import IDENTITY, Array, RelativePose
from hybridmap.graph.edges import Edge
from hybridmap.metrics import StageClock
from hybridmap.streams.base import Observation, Rig
from hybridmap.vision.base import HELD_IMAGES, Belief, SeenGain, View, held
from hybridmap.vision.scanline.closing import Measured, ScanlineCloser, seen_from_newer
from hybridmap.vision.scanline.retina import Glance, Retina, retina_of
from hybridmap.vision.scanline.sequences import Sequences
from hybridmap.vision.scanline.way_ahead import GainMeter, way_ahead
from hybridmap.vision.templates import ViewTemplates

_FARTHEST_M = 1.0
"""Views that match were taken within this of each other, m: a larger way by depth is of something else."""


class ScanlineFrontEnd:
    """Loop closure by scanline profiles in sequence; implements `vision.base.GaugingFrontEnd`.

    A match gives the heading by the shift of the profile, and the way along by the depth ahead or by the scores of the nodes
    around. Nothing is registered: between closures the map is that of self-motion. A node costs a comparison with every
    profile so far. Places are recognised in the direction of the first visit only.

    Args:
        config: settings of the visual side.
        retina: the sensor.
    """

    def __init__(self, config: VisionConfig, retina: Retina) -> None:
        self._retina = retina
        matching, profile = config.matching, config.profile
        self._sequences = Sequences(matching, profile.max_shift)
        self._templates = ViewTemplates(profile.width // 16, matching.mu_r, matching.mu_d)
        self._closer = ScanlineCloser(self._sequences, self._measured, matching.c_t)
        self._meter = GainMeter()
        self._glances: list[Glance] = []
        self._frames: deque[tuple[int, Observation]] = deque(maxlen=HELD_IMAGES)
        self._seen: tuple[Observation, Glance] | None = None

    def observe(self, frame: Observation, delta_node_robot: Array) -> View:
        """Take in a frame, and recognise its view template; see `FrontEnd.observe`."""
        glance = self._retina.glance(frame)
        self._seen = frame, glance
        template = self._templates.recognise(glance.profile)
        return View(frame.stamp_ns, glance.profile, template.template, template.founded)

    def add_node(self, node: int, view: View) -> None:
        """Make a node of the frame that was observed last; see `FrontEnd.add_node`.

        Raises:
            ValueError: no frame was observed yet, or `node` is not the next number.
        """
        if self._seen is None or node != len(self._glances):
            raise ValueError(f"vision: found node {node}, expected node {len(self._glances)} after a frame was observed")
        frame, glance = self._seen
        self._glances.append(glance)
        self._frames.append((node, frame))
        self._sequences.add(view.profile)

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        """Compare the way to the new node by the wheels with that by the views; no edges, as nothing is registered."""
        self._closer.add_node(IDENTITY if odometry is None else odometry.delta)
        if odometry is not None:
            self._meter.step(odometry.delta, self._ahead(node, node - 1, -float(odometry.delta[2])))
        return []

    def close(self, node: int, belief: Belief) -> list[Edge]:
        """Look for a loop closure of the new node; see `FrontEnd.close`."""
        return self._closer.close(node, belief)

    def finish(self, belief: Belief) -> list[Edge]:
        """At the end of the drive, give up what still waits; see `FrontEnd.finish`."""
        return self._closer.give_up(len(self._glances))

    @property
    def gain(self) -> SeenGain | None:
        """k_m by the views; see `GaugingFrontEnd.gain`."""
        return self._meter.gain

    def rescale(self, factor: float) -> None:
        """Take note of a corrected gain; see `GaugingFrontEnd.rescale`."""
        self._closer.rescale(factor)
        self._meter.rescale(factor)

    @property
    def lost_since(self) -> int | None:
        """None: the front-end never takes the robot for lost."""

    def keyframe(self, node: int) -> dict[str, NDArray[np.generic]]:
        """`profile` (bands, width) float32 and the frame as the sensor stores it.

        Raises:
            StreamError: the node's frame is no longer held (see `HELD_IMAGES`); the map file has it.
        """
        return {"profile": self._glances[node].profile, **self._retina.compact(held(self._frames, node))}

    def _measured(self, node: int, older: int) -> Measured:
        yaw = self._retina.yaw_rad(float(self._sequences.shifts[older]))
        nodes = self._sequences.offset_nodes(older)
        beside = older + (1 if nodes > 0.0 else -1)
        along = abs(nodes) * float(self._closer.way(older, beside)[0]) if nodes else 0.0
        seen = self._ahead(node, older, yaw)
        if seen is None or abs(seen) > _FARTHEST_M:
            return Measured(seen_from_newer(along, yaw), by_depth=False)
        return Measured(seen_from_newer(seen, yaw), by_depth=True)

    def _ahead(self, node: int, older: int, yaw_rad: float) -> float | None:
        views = self._glances[older].ahead_m, self._glances[node].ahead_m
        return way_ahead(*views, self._retina.bearings_rad, yaw_rad, self._retina.reach_m)


def create(config: VisionConfig, rig: Rig, seed: int, clock: StageClock) -> ScanlineFrontEnd:
    """Make the scanline front-end for the sensor that `vision.sensor` names, or the first of the rig that it can use.

    Raises:
        ConfigError: the rig has neither laser nor camera of that name.
    """
    del seed, clock
    return ScanlineFrontEnd(config, retina_of(config, rig))
