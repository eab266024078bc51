"""Drives whose calibration is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybridmap.calibration.legs import Motion, chain
from hybridmap.calibration.regression import Sighting
from hybridmap.geometry import RelativePose, between, compose, exp, interpolate
from hybridmap.graph.edges import Edge, EdgeKind, Method, Status
from hybridmap.graph.experience_map import ExperienceMap, Node
from hybridmap.odometry_model import Gains, remove
from hybridmap.store import MapStore, SessionFolder
from hybridmap.streams.base import Rig

STEP_NS = 100_000_000
GAINS = Gains(1.03, 0.97, -0.04)
COVARIANCE = np.diag([1e-4, 1e-4, 3e-5])


@dataclass(frozen=True)
class Drive:
    """A drive: true poses (S + 1, 3), and raw odometry at the same times."""

    truth: np.ndarray
    motion: Motion


def drive(rng, laps=4, gains=GAINS, noise=1.0, drop_outs=0):
    """Drive laps around a room of 8 x 5 m at 0.5 m/s. The robot turns in place in the corners. Each lap changes direction.

    `noise` scales the noise of the odometry: 0.4 deg per sqrt(m) of heading and 1 % of the way. A drop-out is one step that is
    wrong by 0.5 m and 20 deg.
    """
    steps = []
    for lap in range(laps):
        side = 1.0 if lap % 2 == 0 else -1.0
        for length in (8.0, 5.0, 8.0, 5.0):
            steps += [(0.05, 0.0, 0.0)] * round(length / 0.05)
            steps += [(0.001, 0.0, side * np.pi / 2 / 15)] * 15
    true = np.array(steps)
    measured = true + noise * rng.normal(size=true.shape) * [0.002, 0.0, np.radians(0.4) * np.sqrt(0.05)]
    raw = remove(measured, gains)
    bad = rng.choice(len(raw), drop_outs, replace=False)
    raw[bad] += [0.5, 0.0, np.radians(20)]
    stamps = np.arange(len(true) + 1) * STEP_NS + 7
    return Drive(chain(true), Motion(stamps, raw))


def along(rng, steps, noise=1.0):
    """Make a drive of given true steps (S, 3). Its odometry has only the noise; `noise` scales it as in `drive`."""
    true = np.asarray(steps, dtype=np.float64)
    raw = true + noise * rng.normal(size=true.shape) * [0.002, 0.0, np.radians(0.4) * np.sqrt(0.05)]
    return Drive(chain(true), Motion(np.arange(len(true) + 1) * STEP_NS + 7, raw))


def circle(rng, step_m=0.02, turn_rad=0.05, steps=2000, noise=1.0):
    """Drive on a circle at constant speed. Heading bias and turn gain then have the same effect."""
    return along(rng, [(step_m, 0.0, turn_rad)] * steps, noise)


def sighting(one, rng=None, every=10, delay_s=0.0):
    """Observe the true pose every second. The noise is 1 cm and 0.3 deg, and the stamps are late by `delay_s`."""
    chosen = np.arange(every, len(one.truth) - every, every)
    share = delay_s * 1e9 / STEP_NS
    whole = int(np.floor(share))
    poses = interpolate(one.truth[chosen - whole], one.truth[chosen - whole - 1], share - whole)
    if rng is not None:
        poses = compose(poses, exp(rng.normal(size=poses.shape) * [0.01, 0.01, np.radians(0.3)]))
    return Sighting(one.motion, one.motion.stamps_ns[chosen], poses)


def experience_map(one, rng, every=10, registered=False):
    """Make a map with one node per second, odometry edges of raw odometry, and true loops with noise at places seen again.

    Return the map and the index of each node in the odometry.
    """
    chosen = np.arange(0, len(one.truth), every)
    raw = chain(one.motion.steps)
    truth = one.truth[chosen]
    experiences = ExperienceMap()
    code = np.ones(4, dtype=np.float32)
    for number, at in enumerate(chosen):
        node = Node(int(one.motion.stamps_ns[at]), raw[at], code, -1, float(one.motion.travel_m[at]))
        experiences.add_node(node, raw[at])
        if number:
            delta = between(raw[chosen[number - 1]], raw[at])
            covariance = np.diag([4e-4, 4e-4, np.radians(1.0) ** 2])
            edge = Edge(number - 1, number, EdgeKind.ODOMETRY, Status.ACCEPTED, RelativePose(delta, covariance))
            experiences.add_edge(edge)
        for old, kind in _seen_again(truth, number, registered):
            measured = compose(between(truth[number], truth[old]), exp(rng.normal(size=3) * np.sqrt(np.diag(COVARIANCE))))
            experiences.add_edge(Edge(number, old, kind, Status.ACCEPTED, RelativePose(measured, COVARIANCE)))
    return experiences, chosen


def _seen_again(truth, number, registered):
    if registered and number:
        yield number - 1, EdgeKind.REGISTRATION
    near = np.hypot(*(truth[: max(number - 40, 0), :2] - truth[number, :2]).T) < 0.6
    if near.any():
        yield int(np.flatnonzero(near)[0]), EdgeKind.LOOP


def write_session(folder, one, rng, registered=True, gains=None, changes=(), poses=None, sensors="{}", rig=None, methods=()):
    """Write a session folder for a drive. The stored odometry is the raw one corrected by `gains`.

    The loops were measured by `methods` in turn, or nobody says by what.
    """
    from hybridmap.backends.base import SolveReport, SolveStatus
    from hybridmap.odometry_model import NEUTRAL, apply

    used = gains or NEUTRAL
    experiences, chosen = experience_map(one, rng, registered=registered)
    odometry = chain(apply(one.motion.steps, used))
    for change in changes:
        stamp_ns, *values = change
        at = int(np.searchsorted(one.motion.stamps_ns, stamp_ns))
        steps = apply(one.motion.steps[at:], Gains.from_array(values))
        odometry = np.concatenate([odometry[:at], compose(odometry[at], chain(steps))])
    config = (
        f"neural: {{gain: {used.gain}, turn_gain: {used.turn_gain}, heading_bias_rad_m: {used.heading_bias_rad_m}}}\n"
        "backends: {names: [gtsam-cauchy]}\n"
        f"sensors: {sensors}\n"
    )
    session = SessionFolder(folder)
    with session.writing():
        session.write_config(config)
        with MapStore.create(folder, config, rig or Rig(), "drive") as store:
            for number, node in enumerate(experiences.nodes):
                store.add_node(number, node, experiences.initial[number], {}, {})
            for number, edge in enumerate(experiences.edges):
                by = Method(methods[number % len(methods)]) if methods and edge.kind is EdgeKind.LOOP else edge.method
                store.put_edge(number, replace(edge, method=by))
            nodes = np.searchsorted(chosen, np.arange(len(odometry)), side="right") - 1
            for stamp, node, pose in zip(one.motion.stamps_ns, nodes, odometry, strict=True):
                store.add_track(int(stamp), int(node), np.zeros(3), pose)
            report = SolveReport("gtsam-cauchy", SolveStatus.CONVERGED, "done", 5, 10.0, 1.0, 0.1)
            store.put_info("graph_hash", "0")
            store.put_solution("gtsam-cauchy", one.truth[chosen] if poses is None else poses, report)
            if changes:
                store.put_info("gain_changes", [list(change) for change in changes])
        session.write_metrics({"primary_backend": "gtsam-cauchy"}, [])
    return folder
