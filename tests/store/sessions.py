"""Small sessions for the tests of code that reads a session."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridmap.backends.base import SolveReport, SolveStatus
from hybridmap.geometry import RelativePose, between, compose
from hybridmap.graph.edges import Edge, EdgeKind, Proposer, Status, at_least
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.store import MapStore, SessionFolder, trajectory_of
from hybridmap.streams.base import Rig
from hybridmap.streams.laser import Laser
from hybridmap.streams.rgbd import Camera
from hybridmap.trajectory import Trajectory

SECOND = 1_000_000_000
CAMERA = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]], float))
LASER = Laser(np.linspace(-np.pi, np.pi, 181), 0.1, 20.0, np.array([0.1, 0.0, 0.0]))
RIG = Rig(camera=CAMERA, laser=LASER)


def truth_at(stamp_ns: np.ndarray) -> np.ndarray:
    """Return true poses on a circle of radius 2 m. One round takes 40 s."""
    angle = 2 * np.pi * np.asarray(stamp_ns) / (40 * SECOND)
    return np.stack([2 * np.sin(angle), 2 - 2 * np.cos(angle), (angle + np.pi) % (2 * np.pi) - np.pi], axis=-1)


def odometry_of(truth: np.ndarray, bias_rad_per_m: float = 0.03) -> np.ndarray:
    """Return dead reckoning with a heading bias."""
    poses = [truth[0]]
    for step in between(truth[:-1], truth[1:]):
        length = np.hypot(step[0], step[1])
        poses.append(compose(poses[-1], step + np.array([0, 0, bias_rad_per_m * length])))
    return np.array(poses)


def ring_map(laps: float = 1.5, *, loops: bool = True, false_loop: bool = False) -> ExperienceMap:
    """Make a map of the circle with one node per second.

    It has odometry edges. Loops with the true relative pose join nodes one lap apart.
    """
    count = int(40 * laps)
    stamps = np.arange(count) * SECOND
    truth = truth_at(stamps)
    odometry = odometry_of(truth)
    experiences = ExperienceMap()
    code = np.linspace(0, 1, 9, dtype=np.float32)
    covariance = np.diag([1e-4, 1e-4, 1e-5])
    for k in range(count):
        experiences.add_node(Node(int(stamps[k]), odometry[k], code + k, k % 7, 0.314 * k), odometry[k])
        if k:
            relative = RelativePose(between(odometry[k - 1], odometry[k]), covariance * 4)
            experiences.add_edge(Edge(k - 1, k, EdgeKind.ODOMETRY, Status.ACCEPTED, relative))
        if loops and k >= 40:
            relative = RelativePose(between(truth[k], truth[k - 40]) + np.array([0.01, 0, 0]), covariance)
            figures = {"overlap": 0.1 + 0.2}
            checks = (at_least("fit", 0.9, 0.7, "vision.laser.probes.fit_min"),)
            experiences.add_edge(
                Edge(
                    k,
                    k - 40,
                    EdgeKind.LOOP,
                    Status.ACCEPTED,
                    relative,
                    checks=checks,
                    figures=figures,
                    proposed_by=Proposer.PROFILE,
                )
            )
            experiences.add_edge(Edge.decided(k, k - 30, EdgeKind.LOOP, None, [at_least("matches", 8, 12)]))
    if false_loop:
        relative = RelativePose(np.zeros(3), covariance)
        experiences.add_edge(Edge(count - 1, 3, EdgeKind.LOOP, Status.ACCEPTED, relative))
    return experiences


def laser_ranges(pose: np.ndarray, half_m: float = 5.0) -> np.ndarray:
    """Return the ranges to the walls of a square room of 10 m, centred on (0, 2)."""
    yaw = pose[2] + LASER.bearings_rad
    origin = compose(pose, LASER.pose_base_laser)[:2] - [0.0, 2.0]
    with np.errstate(divide="ignore"):
        to_x = (np.sign(np.cos(yaw)) * half_m - origin[0]) / np.cos(yaw)
        to_y = (np.sign(np.sin(yaw)) * half_m - origin[1]) / np.sin(yaw)
    ranges: np.ndarray = np.minimum(to_x, to_y)
    return ranges.astype(np.float32)


def keyframe_of(node: int, truth: np.ndarray) -> dict[str, np.ndarray]:
    """Make a keyframe: laser ranges, a colour image, and a depth image of a wall 2 m ahead."""
    color = np.full((24, 32, 3), [200, node % 256, 10], np.uint8)
    depth = np.full((24, 32), 2000, np.uint16)
    depth[:2] = 0
    return {"ranges_m": laser_ranges(truth[node]), "color": color, "depth_mm": depth, "profile": np.ones((4, 8), np.float32)}


def write_session(
    folder: Path,
    experiences: ExperienceMap,
    *,
    rig: Rig = RIG,
    solve: bool = True,
    keyframes: bool = True,
    ended: bool = True,
) -> SessionFolder:
    """Write a whole session folder for a map. The trajectory of its one back-end is the true one."""
    session = SessionFolder(folder)
    with session.writing():
        session.write_config("backends:\n  names: [gtsam-lm]\n")
        node_stamps = np.array([node.stamp_ns for node in experiences.nodes])
        truth = truth_at(node_stamps)
        with MapStore.create(folder, "backends:\n  names: [gtsam-lm]\n", rig, "circle") as store:
            initial = experiences.pose_graph().initial
            for number, node in enumerate(experiences.nodes):
                frame = keyframe_of(number, truth) if keyframes else {}
                store.add_node(number, node, initial[number], frame, {"phases": np.arange(4.0)})
                store.commit()
            for number, edge in enumerate(experiences.edges):
                store.put_edge(number, edge)
            stamps = np.arange(0, node_stamps[-1] + SECOND // 2, SECOND // 10)
            odometry = odometry_of(truth_at(stamps))
            nodes = np.minimum(stamps // SECOND, len(experiences) - 1)
            for stamp, node, pose in zip(stamps, nodes, odometry, strict=True):
                delta = between(odometry[int(node) * 10], pose)
                store.add_track(int(stamp), int(node), delta, pose)
                store.add_online("gtsam-lm", int(stamp), pose)
            if solve:
                report = SolveReport("gtsam-lm", SolveStatus.CONVERGED, "done", 5, 10.0, 1.0, 0.1)
                store.put_solution("gtsam-lm", truth, report)
            if ended:
                store.put_info("graph_hash", "0")
            track = store.track()
            session.write_trajectory("odometry", track.odometry)
            session.write_trajectory("gtsam-lm_online", store.online("gtsam-lm"))
            if solve:
                session.write_trajectory("gtsam-lm", trajectory_of(track, truth))
        session.write_groundtruth(Trajectory(stamps, truth_at(stamps)))
        session.write_metrics({"graph_hash": "0", "primary_backend": "gtsam-lm", "backends": ["gtsam-lm"]}, [])
    return session
