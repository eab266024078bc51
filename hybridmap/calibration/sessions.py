"""Calibration of recorded sessions: from their loop closures, or from a reference trajectory."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import ODOMETRY
from hybridmap.calibration.estimate import Estimate
from hybridmap.calibration.legs import Motion, corrected
from hybridmap.calibration.regression import Sighting, regress, require_leg
from hybridmap.config import Config
from hybridmap.config.gone import without_gone
from hybridmap.errors import EvaluationError, StoreError, counted
from hybridmap.geometry import Array, between
from hybridmap.graph.edges import EdgeKind, Method, Status
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.odometry_model import GAIN_KEYS, Gains, remove
from hybridmap.store import MapStore, SessionFolder
from hybridmap.streams.sensors import words
from hybridmap.trajectory import Trajectory, known_at

log = logging.getLogger(__name__)

GAIN_CHANGES = "gain_changes"
"""Under this key of the map file: `[stamp_ns, gain, turn_gain, heading_bias_rad_m]` for each change made while driving."""

CLOCK_OFFSET = "clock_offset"
"""Under this key: the offset between views and odometry that was estimated and corrected, s; 0 if it was not."""

ESTIMATORS = ("alternating", "joint")

_IN_USE = {"neural": GAIN_KEYS, "sensors": ("odometry_delay_s",)}
_KEY_M, _KEY_RAD = 0.25, 0.35  # travel or turn between two instants at which a reference is used
_ROUNDS = 5
_BY_PROFILE = {Method.SEQUENCE, Method.PROFILE}
"""What measures loops by profiles alone, which tell no scale."""


@dataclass(frozen=True, slots=True)
class Drive:
    """The data of a session that a calibration needs.

    Attributes:
        name: name of the session's folder.
        motion: raw odometry, without the gains of the session; its stamps include the delay in use.
        graph: nodes and accepted edges.
        stamps_ns: (N,) stamps of the nodes, ns.
        poses: (N, 3) poses of the nodes by the primary back-end, m and rad.
        config: the part of the session's configuration that a calibration needs: gains, delay and back-ends.
        config_tree: the whole configuration, as stored in the map file.
        sensors: description of the session's sensors, for people.
        by_profile: whether nothing is registered, and all its loops are by profiles, which tell no scale.
        delay_s: delay of the odometry in use: as configured, or as estimated while driving, s.
    """

    name: str
    motion: Motion
    graph: PoseGraph
    stamps_ns: NDArray[np.int64]
    poses: Array
    config: Config
    config_tree: dict[str, Any]
    sensors: str
    by_profile: bool = False
    delay_s: float = 0.0


def read_drive(folder: Path) -> Drive:
    """Read a session folder.

    Raises:
        StoreError: the folder holds no session, or its map file has no number for the offset of the clocks.
        ConfigError: gains, delay or back-ends of its configuration are invalid.
        EvaluationError: the session holds no odometry.
    """
    SessionFolder(folder).require()
    with MapStore.open(folder) as store:
        track, experiences, solutions = store.track(), store.map(), store.solutions()
        tree = store.config_tree
        config = _understood(tree, f"{store.path}: configuration")
        changes, primary = store.info(GAIN_CHANGES) or [], store.primary
        offset_s = store.info(CLOCK_OFFSET) or 0.0
        if not isinstance(offset_s, int | float) or not math.isfinite(offset_s):
            raise StoreError(f"{store.path}: {CLOCK_OFFSET}: expected a number of seconds, found {str(offset_s)[:40]}")
        delay_s = (config.sensors.odometry_delay_s or 0.0) + float(offset_s)
        sensors = " and ".join(words(store.rig)) or "no sensor but odometry"
    if len(track) < 2:
        raise EvaluationError(f"{folder}: holds no odometry to calibrate; give a session of a drive with wheel odometry")
    steps = between(track.poses_odom[:-1], track.poses_odom[1:])
    motion = Motion(track.stamps_ns, _raw(steps, track.stamps_ns[:-1], Gains.of(config.neural), changes))
    graph = experiences.pose_graph()
    poses = solutions[primary].poses if primary in solutions else graph.initial
    stamps = np.array([node.stamp_ns for node in experiences.nodes], dtype=np.int64)
    measured = {
        edge.method for edge in experiences.edges if edge.status is Status.ACCEPTED and edge.kind is not EdgeKind.ODOMETRY
    }
    by_profile = bool(measured) and measured <= _BY_PROFILE
    return Drive(str(folder), motion, graph, stamps, poses, config, tree, sensors, by_profile, delay_s)


def estimate_of(
    drives: Sequence[Drive],
    references: Sequence[Trajectory] = (),
    estimator: str | None = None,
    leg_m: float | None = None,
) -> Estimate:
    """Calibrate drives against references, one per drive, or, without references, against their own maps.

    Drives with other sensors than the first are accepted with a warning, as they may be of another kind of robot.

    Args:
        drives: drives of one robot, or of robots of one kind, with the same gains and delay in use.
        references: one ground truth per drive, or none.
        estimator: `alternating` (also None) or `joint`; only without references.
        leg_m: length of the pieces of the drive that are compared, m; None: chosen from the drive. Not for `joint`.

    Raises:
        EvaluationError: an invalid option or combination of options, a wrong number of references, a drive given twice,
            drives with different gains, or too little data.
        BackendError: a map cannot be optimised.
    """
    require_options(len(drives), len(references), estimator, leg_m)
    require_one_calibration(drives)
    for drive in drives[1:]:
        if drive.sensors != drives[0].sensors:
            log.warning(
                "%s maps with %s, %s maps with %s: hardly of one kind of robot, yet calibrated as one",
                *(drives[0].name, drives[0].sensors, drive.name, drive.sensors),
            )
    if references:
        return regress([_seen(drive, truth) for drive, truth in zip(drives, references, strict=True)], leg_m)
    for drive in drives:
        require_closures(drive)
    if estimator != "joint":
        return alternating(drives, leg_m)
    from hybridmap.calibration import joint

    (drive,) = drives
    return joint.solve(drive.graph, drive.motion, drive.stamps_ns, drive.config.backends).estimate


def require_options(sessions: int, references: int, estimator: str | None, leg_m: float | None) -> None:
    """Check the options of a calibration (see `estimate_of`) before anything is read.

    Args:
        sessions: number of sessions.
        references: number of references.
        estimator: name of the estimator, or None.
        leg_m: length of the pieces of the drive that are compared, m, or None.

    Raises:
        EvaluationError: an invalid option or combination of options, or a wrong number of references.
    """
    if estimator is not None and estimator not in ESTIMATORS:
        raise EvaluationError(f"unknown estimator {estimator!r}; there are {', '.join(ESTIMATORS)}")
    if estimator is not None and references:
        raise EvaluationError(f"estimator {estimator!r} and a reference are given; leave out --estimator or --reference")
    if references and references != sessions:
        raise EvaluationError(f"found {references} references for {sessions} sessions, expected one each")
    if estimator == "joint" and sessions != 1:
        raise EvaluationError(f"the joint estimator takes one session, found {sessions}; use `alternating` for several")
    if estimator == "joint" and leg_m is not None:
        raise EvaluationError("--leg cannot be used with the estimator `joint`; leave it out")
    if leg_m is not None:
        require_leg(leg_m)


def require_one_calibration(drives: Sequence[Drive]) -> None:
    """Refuse a recording given twice, and drives that were mapped with different gains or delays.

    Raises:
        EvaluationError: two drives are of one recording, or their gains or delays in use differ.
    """
    for second, drive in enumerate(drives):
        for other in drives[:second]:
            if _same_recording(drive.motion, other.motion):
                raise EvaluationError(f"{drive.name}: the same drive as {other.name}; give each drive once")
            for key, value in _in_use(other.config).items():
                found = _in_use(drive.config)[key]
                if found != value:
                    raise EvaluationError(
                        f"{drive.name}: was mapped with {key} {found:g}, {other.name} with {value:g}; expected one calibration "
                        f"in use; calibrate them one by one, or map both with the same values"
                    )


def common_tree(drives: Sequence[Drive]) -> dict[str, Any]:
    """The whole configuration that all drives share, as a nested mapping.

    Raises:
        EvaluationError: two configurations differ in any setting; the message names the first difference.
    """
    first = _flat(drives[0].config_tree)
    for drive in drives[1:]:
        other = _flat(drive.config_tree)
        for key in sorted(first.keys() | other.keys()):
            if first.get(key) != other.get(key):
                raise EvaluationError(
                    f"{drive.name}: its configuration has {key} {other.get(key)!r}, that of {drives[0].name} "
                    f"{first.get(key)!r}; expected equal ones; leave out --out or map both alike"
                )
    return drives[0].config_tree


def alternating(drives: Sequence[Drive], leg_m: float | None = None) -> Estimate:
    """Calibrate drives on their own maps: alternately regress odometry on the map, and optimise the map with the calibration.

    Maps must have registrations or loops (`require_closures`). `leg_m` is as for `estimate_of`.

    Raises:
        EvaluationError: too little data, as for `regress`.
        BackendError: a map cannot be optimised.
    """
    poses = [drive.poses for drive in drives]
    estimate = _regress_on(drives, poses, leg_m)
    for _ in range(_ROUNDS):
        poses = [_optimise(drive, estimate) for drive in drives]
        before, estimate = estimate, _regress_on(drives, poses, leg_m)
        if np.all(np.abs(estimate.off(before.gains)) < 0.1):
            break
    return estimate


def require_closures(drive: Drive) -> None:
    """Refuse a map of odometry alone, or one whose loops tell no scale: a calibration would only give back their odometry.

    Raises:
        EvaluationError: there is no edge besides odometry (registrations suffice, too), or all of them are loops by profile.
    """
    if drive.by_profile:
        raise EvaluationError(
            f"{drive.name}: its loops are by profile alone and tell no scale, so the gain of its map is that of its odometry: "
            f"give --reference GT.tum, or a session with registrations (configuration rgbd or laser)"
        )
    if not np.any(drive.graph.kinds != EdgeKind.ODOMETRY):
        raise EvaluationError(
            f"{drive.name}: its map holds odometry edges only; a calibration needs others: give --reference GT.tum, "
            f"or a session with loop closures"
        )


def _regress_on(drives: Sequence[Drive], poses: Sequence[Array], leg_m: float | None) -> Estimate:
    sightings = [Sighting(drive.motion, drive.stamps_ns, on_map) for drive, on_map in zip(drives, poses, strict=True)]
    return regress(sightings, leg_m)


def _optimise(drive: Drive, estimate: Estimate) -> Array:
    from hybridmap.backends.registry import ROBUST, create

    gains = estimate.kept(Gains.of(drive.config.neural))
    graph = corrected(drive.graph, drive.motion, drive.stamps_ns, gains, estimate.delay_s)
    name = drive.config.backends.names[0]
    solver = create(ROBUST if name == ODOMETRY else name, drive.config.backends)
    return solver.solve(graph).poses


def _understood(tree: dict[str, Any], origin: str) -> Config:
    """The calibration and back-ends of a session's configuration; the other settings may be of another version."""
    in_use = {
        section: {key: value for key, value in (tree.get(section) or {}).items() if key in keys}
        for section, keys in _IN_USE.items()
    }
    backends = {"backends": tree["backends"]} if "backends" in tree else {}
    return Config.from_tree(without_gone(in_use | backends), origin)


def _in_use(config: Config) -> dict[str, float]:
    return {
        f"{section}.{key}": getattr(getattr(config, section), key) or 0.0 for section, keys in _IN_USE.items() for key in keys
    }


def _same_recording(one: Motion, other: Motion) -> bool:
    """Whether the shorter of two motions is the start of the longer one."""
    steps = min(len(one.steps), len(other.steps))
    same = np.array_equal(one.stamps_ns[: steps + 1], other.stamps_ns[: steps + 1])
    return same and np.allclose(one.steps[:steps], other.steps[:steps], rtol=0.0, atol=1e-6)


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mapping -> `section.key` to value."""
    out: dict[str, Any] = {}
    for key, value in tree.items():
        out |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return out


def _raw(steps: Array, stamps_ns: NDArray[np.int64], gains: Gains, changes: Sequence[Sequence[float]]) -> Array:
    """Remove the gains that were in use at each step."""
    begin = [int(stamps_ns[0]), *(int(change[0]) for change in changes)]
    used = [gains, *(Gains.from_array(change[1:]) for change in changes)]
    parts = np.searchsorted(stamps_ns, begin)
    ends = [*parts[1:], len(steps)]
    return np.concatenate([remove(steps[a:b], g) for a, b, g in zip(parts, ends, used, strict=True)])


def _seen(drive: Drive, truth: Trajectory) -> Sighting:
    """Poses of the reference, at times a little apart."""
    motion = drive.motion
    known = np.flatnonzero(known_at(truth, motion.stamps_ns))
    if len(known) < 2:
        raise EvaluationError(
            f"{drive.name}: {counted(len(known), 'stamp')} in common with the reference, expected many; are they of the same "
            f"recording and on the same clock?"
        )
    mark = np.floor(motion.travel_m / _KEY_M + motion.turned_rad / _KEY_RAD)[known]
    keys = known[np.flatnonzero(np.diff(mark, prepend=-1.0) > 0)]
    stamps = motion.stamps_ns[keys]
    return Sighting(motion, stamps, truth.at(stamps))
