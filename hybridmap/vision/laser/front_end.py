"""The laser front-end: scans in; refined self-motion and committed loop closures out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.vision import VisionConfig
from hybridmap.errors import StreamError
from hybridmap.geometry import IDENTITY, Array, RelativePose, between, compose
from hybridmap.graph.edges import Check, Edge, EdgeKind, Lack, Method, Search, Status
from hybridmap.metrics import StageClock
from hybridmap.streams.base import Observation, Rig
from hybridmap.streams.laser import LASER, Laser, LaserScan
from hybridmap.trajectory import Anchors
from hybridmap.vision.base import UNEXPECTED, Belief, Division, View
from hybridmap.vision.laser import checks
from hybridmap.vision.laser.cloud import CELL_M, Cloud, Scale, cloud_of_scan
from hybridmap.vision.laser.commitment import Commitment
from hybridmap.vision.laser.dense_trajectory import DenseTrajectory, ObservedScan
from hybridmap.vision.laser.division import divide
from hybridmap.vision.laser.hypotheses import LENGTH_M, Prober
from hybridmap.vision.laser.kidnapping import Continuity, GlobalLocalisation
from hybridmap.vision.laser.meeting import ScanMeeting
from hybridmap.vision.laser.panorama import ALIKE, Panoramas
from hybridmap.vision.laser.revisits import Reviser
from hybridmap.vision.laser.submap import Atlas, violation_of_step
from hybridmap.vision.laser.tracking import Step, Tracker, contradicts
from hybridmap.vision.laser.witness import ScanWitness
from hybridmap.vision.profile import laser_profile
from hybridmap.vision.templates import ViewTemplates

LAST_PROBE_M = 0.5
"""Travel since the last probe after which the end of the drive is worth one of its own."""

MOST_BETWEEN = 30
"""Scans between two nodes that a weak registration is retried with, at most."""


class LaserFrontEnd:
    """Loop closure by registration of laser submaps; implements `vision.base.DenseFrontEnd`, `VerifyingFrontEnd`,
    `PartingFrontEnd`, `MeetingFrontEnd`, `FollowingFrontEnd` and `second_opinion.LocalisingFrontEnd`.

    Attributes:
        atlas: the scans of the nodes, from which submaps are made.
        localisation: whether the robot is lost, and its global localisation.
        witness: tells where on the whole map scans fit; None if the robot is taken never to be lost.
    """

    def __init__(self, config: VisionConfig, laser: Laser) -> None:
        """Start without a node."""
        self._config, self._refines, self._profile_width = config.laser, config.tracking.enabled, config.profile.width
        self._laser = laser
        self.atlas = Atlas()
        self._tracker = Tracker(self.atlas)
        proposed = 0 if config.closing.by == "proximity" else ALIKE
        self._panoramas = Panoramas(self.atlas, config.profile.width, proposed)
        self._prober = Prober(config, self.atlas, laser, self._panoramas)
        self._reviser = Reviser(config, self.atlas, laser, self._panoramas)
        self._commitment = Commitment(self.atlas.travel_m.__getitem__)
        self._templates = ViewTemplates(config.profile.width // 16, config.matching.mu_r, config.matching.mu_d)
        self._profiles: list[NDArray[np.float32]] = []
        self._continuity = Continuity(config, self.atlas, laser, self._tracker)
        self.localisation = GlobalLocalisation(
            config, self.atlas, self._prober, self._continuity, self._profiles, self._next_key
        )
        self.witness = (
            ScanWitness(self.atlas, self._prober, self._reviser, self.localisation, self._continuity, self._next_key)
            if config.relocalising.enabled
            else None
        )
        self._meeting = ScanMeeting(
            config, self.atlas, self._panoramas, self._prober, self._reviser, self.localisation, self._next_key
        )
        self._dense_trajectory = DenseTrajectory(self.atlas, laser)
        self._scans: list[ObservedScan] = []
        self._steps: list[Array] = []
        self._between: list[ObservedScan] = []
        self._node: tuple[int, Cloud, LaserScan] | None = None
        self._seen_from = self._before = -1  # now; when the newest node was made
        self._last_probe_m = 0.0
        self._keys = 0

    def observe(self, frame: Observation, delta_node_robot: Array) -> View:
        """Take in one scan; see `FrontEnd.observe`.

        Raises:
            StreamError: the frame is no scan, or has another number of beams than the laser.
        """
        if not isinstance(frame, LaserScan):
            raise StreamError(f"laser: expected a LaserScan, found {type(frame).__name__}")
        if frame.ranges_m.shape != self._laser.bearings_rad.shape:
            beams = len(self._laser.bearings_rad)
            raise StreamError(f"laser: scan at {frame.stamp_ns} ns: expected {beams} ranges, found {frame.ranges_m.shape}")
        self.atlas.scene.observe(frame.ranges_m)
        motion, followed = np.array(delta_node_robot, dtype=np.float64), self._seen_from != len(self._profiles) - 1
        self._scans.append(ObservedScan(frame, self._seen_from, motion, followed))
        profile = laser_profile(frame.ranges_m, self._laser.bearings_rad, self._profile_width)
        if not self._config.scan.templates:
            return View(frame.stamp_ns, profile, -1, False)
        seen = self._templates.recognise(profile)
        return View(frame.stamp_ns, profile, seen.template, seen.founded)

    def add_node(self, node: int, view: View) -> None:
        """Make a node of the scan that was observed last; see `FrontEnd.add_node`."""
        seen = self._scans.pop()
        self._between = [s for s in self._scans[-MOST_BETWEEN:] if s.node == seen.node >= 0 and s.followed == seen.followed]
        if node > 0:
            self._steps.append(np.full(3, np.nan) if seen.followed else seen.motion)
        self._before, self._seen_from = self._seen_from, node
        self._scans.append(ObservedScan(seen.scan, node, IDENTITY))
        self._profiles.append(view.profile)
        self._node = (node, self._cloud(seen.scan), seen.scan)

    def track(self, node: int, odometry: RelativePose | None) -> list[Edge]:
        """Register the new node to the submap of the nodes just before it, or about the one that it was followed on.

        See `FrontEnd.track` and `FollowingFrontEnd.follow`.

        Returns no edges for the first node, nor where `vision.tracking.enabled` is false.
        """
        assert self._node is not None
        number, cloud, scan = self._node
        assert number == node
        if odometry is None:
            self.atlas.add(cloud, scan.ranges_m, IDENTITY.copy(), np.zeros((3, 3)))
            return []
        if not self._refines:
            self.atlas.add(cloud, scan.ranges_m, compose(self.atlas.chain[-1], odometry.delta), odometry.covariance)
            return []
        before = self._before
        step = self._tracker.step(cloud, odometry, self._clouds_between, before)
        pose = compose(self.atlas.chain[before], step.relative.delta)
        self.atlas.add(cloud, scan.ranges_m, pose, step.scatter, before)
        broken = self._continuity.broken(node, step, odometry, [(seen.motion, seen.scan) for seen in self._between])
        return self.localisation.tracked(self._registration(node, step), broken, odometry.delta)

    def close(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loops of the new node, and decide pending ones; see `FrontEnd.close`.

        A lost robot is compared with the whole map. Unless that localises it at this node, the last metres are compared with
        older submaps, every few metres.
        """
        sought = self.localisation.search(node, belief)
        travel_m = self.atlas.travel_m[node]
        if sought.accepted or travel_m - self._last_probe_m < self._config.probes.every_m:
            return sought.proposals
        out = sought.proposals + self._probe(node, belief)
        settled = [s.proposed() for s in self._commitment.settle(travel_m, belief)]
        return out + settled + (self.localisation.closed() if any(p.status is Status.ACCEPTED for p in settled) else [])

    def _probe(self, node: int, belief: Belief) -> list[Edge]:
        self._last_probe_m = self.atlas.travel_m[node]
        self._panoramas.extend()
        hypotheses, out = self._prober.probe(node, belief, self.localisation.since), []
        self.localisation.probed(node, hypotheses, belief)
        for hypothesis in hypotheses:
            key = self._next_key()
            out.append(hypothesis.proposed(key, Lack.WAITING))
            self._commitment.add(key, hypothesis)
        return out

    def finish(self, belief: Belief) -> list[Edge]:
        """At the end of the drive, decide all pending loops; if none is accepted, register nodes near each other on the map.

        See `FrontEnd.finish`.
        """
        self._panoramas.extend(to_the_end=True)
        last, out = len(self.atlas) - 1, []
        if last >= 0 and self.atlas.travel_m[last] - self._last_probe_m > LAST_PROBE_M:
            out = self._probe(last, belief)
        settled = self._commitment.flush(belief)
        out += self.localisation.finish() + [s.proposed() for s in settled]
        if any(s.accepted for s in settled):
            return out
        near = self._reviser.round(belief, self.localisation.since)
        return out + [hypothesis.proposed(self._next_key()) for hypothesis in near]

    def verify(self, outliers: Sequence[Edge], belief: Belief) -> list[Edge]:
        """Measure again, from the poses of the map, loops that a back-end down-weighted as outliers; returns all of them."""
        poses = belief.poses_map_node
        again = [self._reviser.register(e.source, e.target, poses, e.proposed_by, Search.AGAIN) for e in outliers]
        return [found.proposed(edge.key) for found, edge in zip(again, outliers, strict=True)]

    @property
    def reach_m(self) -> float:
        """Travel from a node within which the scans of others take part in its loops, m."""
        return LENGTH_M

    def way(self, node: int) -> tuple[Check, ...]:
        """Check whether the scan of a node (not the first) and that of the node before look through each other's walls."""
        motion = between(self.atlas.chain[self.atlas.before(node)], self.atlas.chain[node])
        return checks.of_way(None, violation_of_step(node, motion, self.atlas, self._laser))

    def unexpected(self, loop: Edge) -> bool:
        """Whether a loop was refused only because of the gate, or as too few others agreed with it, or others did not."""
        return loop.lack in UNEXPECTED and checks.unexpected(loop.failed)

    @property
    def follows(self) -> bool:
        """Whether registrations tell where the robot is; see `FollowingFrontEnd.follows`."""
        return self._refines and not self.localisation.doubts

    def recognise(self, node: int, expected: Array) -> RelativePose | None:
        """Register the newest scan to those about an older node; see `FollowingFrontEnd.recognise`."""
        return self._tracker.recognise(node, self._cloud(self._scans[-1].scan), expected)

    def follow(self, node: int) -> None:
        """From now on the robot is seen from an earlier node; see `FollowingFrontEnd.follow`."""
        self._seen_from = node
        self._scans[-1] = replace(self._scans[-1], followed=True)

    def divided(self, place: int, poses: Array) -> Division | None:
        """Ask single scans on which side of a kidnapping they were taken; see `division.divide`."""
        return divide(self.atlas, place, poses)

    def part(self, node: int) -> None:
        """Begin a new piece of the atlas at a node: the robot was kidnapped before it."""
        self.atlas.part(node)

    def overrules(self, registration: RelativePose, odometry: RelativePose) -> bool:
        """Whether a good registration says that the odometry is wrong; see `Overruling.overrules`."""
        return contradicts(registration.delta, odometry.delta)

    def dense_trajectory(self, belief: Belief) -> Anchors:
        """Register every scan to the final map; empty where `vision.laser.dense_trajectory` is false."""
        scans = [s for s in self._scans if s.node >= 0] if self._config.dense_trajectory else []
        return self._dense_trajectory.dense_trajectory(scans, np.array(self._steps), belief.poses_map_node)

    @property
    def lost_since(self) -> int | None:
        """Node before which the robot was kidnapped last, if it has not been found on the map since; else None."""
        return self.localisation.lost_since

    def keyframe(self, node: int) -> dict[str, NDArray[np.generic]]:
        """`profile` (1, width) and `ranges_m` (B,) of a node's scan, float32."""
        return {"profile": self._profiles[node], **LASER.compact(LaserScan(0, self.atlas.ranges[node]))}

    def state(self, node: int) -> dict[str, NDArray[np.generic]]:
        """`chain` (3,), `scatter` (3, 3) and `cell_m` () of a node, as the atlas has them.

        Of a node that was made after the robot was followed on older ones also `back` (): it was seen from the node so many
        numbers before.
        """
        atlas = self.atlas
        own = {"chain": atlas.chain[node], "scatter": atlas.scatter[node], "cell_m": np.array(atlas.clouds[node].cell_m)}
        return own | ({"back": np.array(node - atlas.resumed[node])} if node in atlas.resumed else {})

    def restore(
        self, node: int, keyframe: Mapping[str, NDArray[np.generic]], state: Mapping[str, NDArray[np.generic]], begins: bool
    ) -> None:
        """Take up a node of a finished session; see `MeetingFrontEnd.restore`."""
        ranges_m = np.asarray(keyframe.get("ranges_m", np.zeros(0)), dtype=np.float32)
        if ranges_m.shape != self._laser.bearings_rad.shape or not {*state} >= {"chain", "scatter", "cell_m"}:
            beams, found = len(self._laser.bearings_rad), ", ".join([*keyframe, *state]) or "nothing"
            raise StreamError(
                f"laser: node {node} of a stored map: expected a scan of {beams} ranges and its place along the chain, found "
                f"{found}; map its source again"
            )
        cloud = cloud_of_scan(ranges_m, self._laser, Scale(float(state["cell_m"]) / CELL_M))
        back = int(state.get("back", 1))
        self.atlas.take_up(cloud, ranges_m, np.asarray(state["chain"]), np.asarray(state["scatter"]), begins, back)
        self._profiles.append(np.asarray(keyframe["profile"], dtype=np.float32))
        self._seen_from = node

    def arrive(self, first: int, *, guessed: bool = False) -> None:
        """A session begins whose place on the map is to be found; see `MeetingFrontEnd.arrive`."""
        self._meeting.arrive(first, guessed=guessed)

    def meet(self, node: int, belief: Belief) -> list[Edge]:
        """Look for loops of a node to earlier sessions; see `MeetingFrontEnd.meet`."""
        return self._meeting.meet(node, belief)

    def meet_again(self, belief: Belief) -> list[Edge]:
        """Decide pending loops, and register nodes near each other on the map; see `MeetingFrontEnd.meet_again`."""
        return self._meeting.meet_again(belief)

    def _next_key(self) -> int:
        self._keys += 1
        return self._keys - 1

    def _cloud(self, scan: LaserScan) -> Cloud:
        return cloud_of_scan(scan.ranges_m, self._laser, self.atlas.scene.scale)

    def _clouds_between(self) -> Iterator[tuple[Array, Cloud]]:
        return ((seen.motion, self._cloud(seen.scan)) for seen in self._between)

    def _registration(self, node: int, step: Step) -> Edge:
        by_wheels = not step.measured and self._before != node - 1  # nothing else joins it to the node that it was seen from
        return Edge.decided(
            self._before,
            node,
            EdgeKind.REGISTRATION,
            step.relative if step.measured or by_wheels else None,
            () if by_wheels else step.checks,
            method=Method.ODOMETRY if by_wheels else Method.SCANS,
            search=Search.CHAIN,
            figures={"fit": step.fit},
            key=self._next_key(),
            contradicts_odometry=step.contradicts_odometry,
        )


def create(config: VisionConfig, rig: Rig, seed: int, clock: StageClock) -> LaserFrontEnd:
    """Make the laser front-end; `seed` and `clock` are not used."""
    del seed, clock
    return LaserFrontEnd(config, rig.sensors[LASER.sensor_name])
