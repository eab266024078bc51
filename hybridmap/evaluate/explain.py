"""Explain the decisions at one node or one time of a session, from the map file alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.base import ODOMETRY
from hybridmap.errors import EvaluationError
from hybridmap.evaluate.why_not import NO_LOOPS, NO_NODE
from hybridmap.geometry import Array, between
from hybridmap.graph.edges import Check, Edge, EdgeKind, Status
from hybridmap.graph.experience_map import ExperienceMap
from hybridmap.store import MapStore, SessionFolder
from hybridmap.streams.sensors import carried
from hybridmap.trajectory import NS_PER_S, Trajectory, format_motion, known_at, read_tum
from hybridmap.vision.gating import MIN_AGE_S, Gate

_AT_NODE_NS = 1_000
_STAMPS_FROM_S = 1e6  # a time beyond it is a stamp, not seconds since the start
_STAMPS_UP_TO_S = 9e9  # beyond it nanoseconds do not fit into 64 bits


@dataclass(frozen=True, slots=True)
class Decision:
    """One edge that was considered, with its outcome.

    Attributes:
        number: number of the edge in the map file.
        edge: the edge, with the checks and the verdict.
        weights: back-end -> weight 0..1 that it gives to an accepted loop (0: rejected by this back-end); else empty.
        inconsistent: names of the back-ends that rejected the loop as inconsistent with other loops.
        error: distance (m) and turn (deg) between its measurement and ground truth; None if unknown.
    """

    number: int
    edge: Edge
    weights: Mapping[str, float] = field(default_factory=dict)
    inconsistent: tuple[str, ...] = ()
    error: tuple[float, float] | None = None

    def to_json(self) -> dict[str, Any]:
        """The decision as a dictionary of JSON values."""
        e = self.edge
        return {
            "edge": self.number,
            "source": e.source,
            "target": e.target,
            "kind": e.kind.name.lower(),
            "status": str(e.status),
            "reason": e.reason,
            "since_node": e.since_node,
            "relative": None if e.relative is None else e.relative.delta.tolist(),
            "checks": [_told(check) for check in e.checks],
            "lack": e.lack,
            "method": e.method,
            "search": e.search,
            "proposed_by": e.proposed_by,
            "figures": {name: _plain(value) for name, value in e.figures.items()},
            "carried_m": e.kidnapped_m,
            "broken_by": [_told(check) for check in e.broken_by],
            "contradicts_odometry": e.contradicts_odometry,
            "otherwise": e.otherwise,
            "weights": dict(self.weights),
            "inconsistent": list(self.inconsistent),
            **dict(zip(("error_m", "error_deg"), self.error or (None, None), strict=True)),
        }


@dataclass(frozen=True, slots=True)
class NodeStory:
    """The decisions made at one node.

    Attributes:
        node: number of the node.
        stamp_ns, time_s: stamp of its frame, and seconds since the first stamp of the recording.
        travel_m: path length from the start to the node.
        moved: distance (m) and turn (deg, unsigned) by odometry since the previous node; None for the first.
        nearest: of the nodes old enough for a loop, the nearest on the final map: (node, m, deg); None if there is none.
        template, founded: number of its view template, and whether the node created that template.
        poses: `odometry` or back-end -> (3,) final pose of the node, m and rad.
        gate: the region in which older nodes were considered for a loop, None if not stored.
        ranked: (n, 3) the best older nodes by the scores of their views: node, score G, shift in columns.
        chain: odometry and registration edges that end at the node.
        loops: loop closures considered when the node was made, or proposed for it after the drive.
        no_loops: why no loop was considered; empty if unknown.
        later: loop closures that later nodes considered with this one.
    """

    node: int
    stamp_ns: int
    time_s: float
    travel_m: float
    moved: tuple[float, float] | None
    nearest: tuple[int, float, float] | None
    template: int
    founded: bool
    poses: Mapping[str, Array]
    gate: Gate | None
    ranked: Array
    chain: list[Decision]
    loops: list[Decision]
    no_loops: str
    later: list[Decision]

    def to_json(self) -> dict[str, Any]:
        """The decisions at the node as a dictionary of JSON values."""
        return {
            "node": self.node,
            "stamp_ns": self.stamp_ns,
            "time_s": self.time_s,
            "travel_m": self.travel_m,
            "moved_m": None if self.moved is None else self.moved[0],
            "moved_deg": None if self.moved is None else self.moved[1],
            "nearest_older": None if self.nearest is None else dict(zip(("node", "m", "deg"), self.nearest, strict=True)),
            "template": self.template,
            "founded_template": self.founded,
            "poses": {name: pose.tolist() for name, pose in self.poses.items()},
            "gate": None if self.gate is None else asdict(self.gate),
            "ranked": [{"node": int(r[0]), "profile_G": float(r[1]), "shift": int(r[2])} for r in self.ranked],
            "chain": [decision.to_json() for decision in self.chain],
            "loops": [decision.to_json() for decision in self.loops],
            "no_loops": self.no_loops,
            "later": [decision.to_json() for decision in self.later],
        }


@dataclass(frozen=True, slots=True)
class FrameStory:
    """The decisions made at one time of a recording.

    Attributes:
        stamp_ns, time_s: stamp of a message (odometry or a view) nearest to the time asked for, and seconds since the first.
        at_node: the last node made until then.
        moved: distance (m) and turn (deg) since that node.
        made: whether a node was made at this time.
        reason: why a node was made, or why not.
        next_node, next_time_s: the next node and its time, None if none follows.
        poses: `odometry` or back-end -> (3,) the robot's pose as it was estimated at this time, m and rad.
    """

    stamp_ns: int
    time_s: float
    at_node: int
    moved: tuple[float, float]
    made: bool
    reason: str
    next_node: int | None
    next_time_s: float | None
    poses: Mapping[str, Array]

    def to_json(self) -> dict[str, Any]:
        """The decisions at the time as a dictionary of JSON values."""
        return {
            "stamp_ns": self.stamp_ns,
            "time_s": self.time_s,
            "at_node": self.at_node,
            "moved_m": self.moved[0],
            "moved_deg": self.moved[1],
            "made_node": self.made,
            "reason": self.reason,
            "next_node": self.next_node,
            "next_time_s": self.next_time_s,
            "poses": {name: pose.tolist() for name, pose in self.poses.items()},
        }


class Explainer:
    """Answers questions about the decisions in one session. A context manager: it holds the map file open, and closes it.

    Args:
        folder: the session folder.

    Raises:
        StoreError: the folder holds no session.
        EvaluationError: the session's map holds no node.
    """

    def __init__(self, folder: Path) -> None:
        SessionFolder(folder).require()
        self._folder = SessionFolder(folder)
        self._store = MapStore.open(folder)
        self._map: ExperienceMap = self._store.map()
        if len(self._map) == 0:
            self._store.close()
            raise EvaluationError(f"{folder}: its map holds no node, so there is nothing to explain")
        self._settings: dict[str, Any] = self._store.config_tree

    def __enter__(self) -> Explainer:
        return self

    def __exit__(self, *_: object) -> None:
        self._store.close()

    @property
    def primary(self) -> str:
        """Name of the session's primary back-end."""
        return self._store.primary

    def node(self, number: int) -> NodeStory:
        """The decisions made at the node with this number.

        Raises:
            EvaluationError: the node does not exist.
        """
        if not 0 <= number < len(self._map):
            raise EvaluationError(f"{self._folder.path}: node {number} does not exist; expected one of 0..{len(self._map) - 1}")
        node, kept = self._map.node(number), self._store.keyframe(number)
        before = self._map.node(number - 1) if number else None
        earlier = {n.template for n in self._map.nodes[:number]}
        edges = [self._decision(n, e) for n, e in enumerate(self._map.edges) if number in (e.source, e.target)]
        newest = [d for d in edges if max(d.edge.source, d.edge.target) == number]
        gate = Gate.of_array(kept["gate"]) if "gate" in kept else None
        loops = [d for d in newest if d.edge.kind is EdgeKind.LOOP]
        return NodeStory(
            node=number,
            stamp_ns=node.stamp_ns,
            time_s=self._since_start(node.stamp_ns),
            travel_m=node.travel_m,
            moved=None if before is None else _moved(between(before.pose_odom, node.pose_odom)),
            nearest=self._nearest(number),
            template=node.template,
            founded=node.template >= 0 and node.template not in earlier,
            poses=self._poses(number),
            gate=gate,
            ranked=np.asarray(kept.get("ranked", np.zeros((0, 3))), dtype=np.float64),
            chain=[d for d in newest if d.edge.kind is not EdgeKind.LOOP],
            loops=loops,
            no_loops="" if loops else self._why_no_loops(number, gate),
            later=[d for d in edges if d not in newest and d.edge.kind is EdgeKind.LOOP],
        )

    def frame(self, time_s: float) -> FrameStory:
        """The decisions at the stamp of a message, of odometry or a view, nearest to a time.

        Args:
            time_s: seconds since the start of the recording, or from 1e6 on a stamp, s.

        Raises:
            EvaluationError: the time is farther from every stamp than the longest gap between them (at least 1 s).
        """
        track = self._store.track()
        stamps = track.stamps_ns
        if len(stamps) == 0:
            raise EvaluationError(f"{self._folder.path}: its map holds no frame")
        at = _nearest_frame(stamps, time_s)
        if at is None:
            span = self._since_start(int(stamps[-1]))
            raise EvaluationError(
                f"{self._folder.path}: no frame at {time_s:g} s; expected 0..{span:.3f} s from the start, or a stamp in "
                f"{stamps[0] / NS_PER_S:.3f}..{stamps[-1] / NS_PER_S:.3f} s"
            )
        stamp, node, since = int(stamps[at]), int(track.nodes[at]), track.deltas[at]
        if node + 1 < len(self._map) and self._is_of(node + 1, stamp):  # motion comes before the view at the same stamp
            node, since = node + 1, np.zeros(3)
        made, moved = self._is_of(node, stamp), _moved(since)
        after = self._map.node(node + 1) if node + 1 < len(self._map) else None
        believed = {ODOMETRY: track.poses_odom[at]}
        for name in self._store.online_backends():
            if len(online := self._store.online(name)):
                believed[name] = online.at(np.array([stamp]))[0]
        return FrameStory(
            stamp_ns=stamp,
            time_s=self._since_start(stamp),
            at_node=node,
            moved=moved,
            made=made,
            reason=self._why_a_node(node) if made else self._why_no_node(moved),
            next_node=None if after is None else node + 1,
            next_time_s=None if after is None else self._since_start(after.stamp_ns),
            poses=believed,
        )

    def _is_of(self, number: int, stamp_ns: int) -> bool:
        """Whether a node was made at a time."""
        return abs(self._map.node(number).stamp_ns - stamp_ns) <= _AT_NODE_NS

    def _why_a_node(self, number: int) -> str:
        if number == 0:
            return "first experience"
        moved = _moved(between(self._map.node(number - 1).pose_odom, self._map.node(number).pose_odom))
        if _setting(self._settings, "nodes.rule") in NO_NODE:
            return f"a new place or view, {format_motion(*moved)} since node {number - 1}"
        return f"{format_motion(*moved)} since node {number - 1}; {self._node_rule()}"

    def _why_no_node(self, moved: tuple[float, float]) -> str:
        if (rule := _setting(self._settings, "nodes.rule")) in NO_NODE:
            return NO_NODE[rule].format(_setting(self._settings, "nodes.place_threshold"))
        limits = [_setting(self._settings, f"nodes.{name}") for name in ("distance_m", "angle_deg")]
        due = any(value >= limit for value, limit in zip(moved, limits, strict=True) if isinstance(limit, int | float))
        why = f"no view at this instant, though {format_motion(*moved)}" if due else f"only {format_motion(*moved)}"
        return f"{why} since the last node; {self._node_rule()}"

    def _node_rule(self) -> str:
        metres, degrees = (_setting(self._settings, f"nodes.{name}") for name in ("distance_m", "angle_deg"))
        return f"a node is made every {metres} m (nodes.distance_m) or {degrees} deg (nodes.angle_deg)"

    def _since_start(self, stamp_ns: int) -> float:
        return (stamp_ns - self._first_ns) / NS_PER_S

    @cached_property
    def _first_ns(self) -> int:
        stamps = self._store.track().stamps_ns
        return int(stamps[0]) if len(stamps) else self._map.node(0).stamp_ns

    @cached_property
    def _truth(self) -> Trajectory | None:
        return read_tum(self._folder.groundtruth) if self._folder.groundtruth.is_file() else None

    def _poses(self, number: int) -> dict[str, Array]:
        out = {ODOMETRY: self._map.node(number).pose_odom}
        for name, solution in self._store.solutions().items():
            if number < len(solution.poses):
                out[name] = solution.poses[number]
        return out

    def _why_no_loops(self, number: int, gate: Gate | None) -> str:
        if number == 0:
            return "it is the first node"
        if gate is not None:
            if gate.older == 0:
                return f"no node was old enough: {MIN_AGE_S:g} s"
            return "no older node lay inside the gate" if gate.inside == 0 else ""
        if (by := _setting(self._settings, "vision.closing.by")) in NO_LOOPS:
            return NO_LOOPS[by]
        for kind, _ in carried(self._store.rig):
            every = _setting(self._settings, kind.seeks_every)
            if isinstance(every, int | float):
                return f"the {kind.name} looks for them every {every:g} m of travel ({kind.seeks_every}), inside its gate"
        return ""

    def _nearest(self, number: int) -> tuple[int, float, float] | None:
        """The nearest node by distance and turn together (1 rad counts as 1 m), among those old enough to be loops."""
        young_ns = round(MIN_AGE_S * NS_PER_S)
        stamps = np.array([node.stamp_ns for node in self._map.nodes[:number]], dtype=np.int64)
        old = np.flatnonzero(stamps <= self._map.node(number).stamp_ns - young_ns)
        solution = self._store.solutions().get(self.primary)
        if len(old) == 0 or solution is None or number >= len(solution.poses):
            return None
        apart = between(solution.poses[number], solution.poses[old])
        metres, turned = np.hypot(apart[:, 0], apart[:, 1]), np.abs(apart[:, 2])
        best = int(np.argmin(metres + turned))
        return int(old[best]), float(metres[best]), float(np.degrees(turned[best]))

    def _decision(self, number: int, edge: Edge) -> Decision:
        weights, inconsistent = {}, []
        if edge.kind is EdgeKind.LOOP and edge.status is Status.ACCEPTED:
            for name, solution in self._store.solutions().items():
                report = solution.report
                weights[name] = 0.0 if number in report.rejected_edge_ids else report.weights.get(number, 1.0)
                inconsistent += [name] if number in report.inconsistent_edge_ids else []
            weights.pop("odometry", None)
        return Decision(number, edge, weights, tuple(inconsistent), self._error(edge))

    def _error(self, edge: Edge) -> tuple[float, float] | None:
        if self._truth is None or edge.relative is None:
            return None
        stamps = np.array([self._map.node(end).stamp_ns for end in (edge.source, edge.target)], dtype=np.int64)
        if not known_at(self._truth, stamps).all():
            return None
        poses = self._truth.at(stamps)
        return _moved(between(between(poses[0], poses[1]), edge.relative.delta))


def _nearest_frame(stamps_ns: NDArray[np.int64], time_s: float) -> int | None:
    """The index of the nearest stamp; None outside the recording, and for NaN."""
    if not abs(time_s) <= _STAMPS_UP_TO_S:
        return None
    since_ns = 0 if time_s >= _STAMPS_FROM_S else int(stamps_ns[0])
    apart = np.abs(stamps_ns - (since_ns + round(time_s * NS_PER_S)))
    at = int(np.argmin(apart))
    return at if apart[at] <= np.max(np.diff(stamps_ns), initial=NS_PER_S) else None


def _setting(settings: Mapping[str, Any], dotted: str) -> Any:
    """A value of a nested configuration; None where there is none."""
    value: Any = settings
    for key in dotted.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _told(check: Check) -> dict[str, Any]:
    return {**asdict(check), "value": _plain(check.value), "limit": _plain(check.limit), "passed": check.passed}


def _plain(value: float) -> float | None:
    """A number as JSON can hold it: none for NaN and infinity."""
    return float(value) if np.isfinite(value) else None


def _moved(delta: Array) -> tuple[float, float]:
    """Distance, m, and turn, degrees."""
    return float(np.hypot(delta[0], delta[1])), float(np.degrees(abs(delta[2])))
