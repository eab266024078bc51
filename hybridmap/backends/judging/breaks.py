"""Rejected loops against the chain of motion: whether a break of the chain before some node frees them.

Robust back-ends take the chain of motion for known. Where the robot was carried, the few edges across then outweigh any
number of true loops. Those loops agree with each other all the same: they want the rest of the map moved alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.backends.judging.clusters import loops_of
from hybridmap.backends.objective import squared_norms
from hybridmap.geometry import Array, between, compose, inverse, log, wrap_angle
from hybridmap.graph.agreement import Indices, Loops, Ring
from hybridmap.graph.edges import EdgeKind
from hybridmap.graph.paths import Chain
from hybridmap.graph.pose_graph import PoseGraph

Mask = NDArray[np.bool_]

LEAST_LOOPS, LEAST_NODES = 6, 4
"""Fewest loops of a group, and fewest newer nodes that they come from: similar places seldom agree so often."""
OUTWEIGHS = 4.0
"""The freed loops must be so many times those that are lost."""
GAIN = 0.5
"""Least fall of the truncated cost, as a share of what the freed loops cost while they were rejected."""
FARTHER = 3.0
"""A carry is refuted where dead reckoning with it is so many times as far from the loops as without it. Wheels that err by as
much as the robot was carried refute one carry in a hundred by chance, better and worse ones fewer."""
SAME_M, SAME_DEG = 0.1, 2.0
"""Loops that move the map by less contradict the noise of the solution and not the solution, m and degrees."""
LOOSE_M, LOOSE_RAD = 0.5, float(np.deg2rad(10.0))
"""Standard deviations of the edge in place of a chain that is taken apart, m and rad: loose, as the loops place the node."""


def is_group(graph: PoseGraph, edges: Indices) -> bool:
    """Whether loops, given by indices (L,), are at least `LEAST_LOOPS` from at least `LEAST_NODES` newer nodes."""
    newer = np.maximum(graph.sources[edges], graph.targets[edges])
    return len(edges) >= LEAST_LOOPS and len(np.unique(newer)) >= LEAST_NODES


def moves(motion: Array, poses: Array, place: int) -> bool:
    """Whether a transform (3,) of the map, m and rad, moves the node `place` by more than `SAME_M` or `SAME_DEG`."""
    shift_m, shift_deg = shift(motion, poses, place)
    return shift_m > SAME_M or shift_deg > SAME_DEG


def shift(motion: Array, poses: Array, place: int) -> tuple[float, float]:
    """How far a transform (3,) of the map, m and rad, moves the node `place`: distance, m, and turn, degrees, 0 or more."""
    off = between(poses[place], compose(motion, poses[place]))
    return float(np.hypot(off[0], off[1])), float(np.rad2deg(abs(off[2])))


def leads_across(graph: PoseGraph, place: int) -> Mask:
    """(E,) which edges join a node before `place` to that node or a later one, in either direction."""
    low, high = np.minimum(graph.sources, graph.targets), np.maximum(graph.sources, graph.targets)
    return np.asarray((low < place) & (high >= place))


def wanted_motion(graph: PoseGraph, poses: Array, edges: Indices, place: int) -> Array:
    """The transform (3,) of the map, m and rad, that loops, given by indices (L,), want: the median of where they put a node.

    They are carried to the node `place` along the map with poses (N, 3).
    """
    loops = loops_of(graph, edges)
    seen = compose(poses[loops.older], loops.relative.delta)
    placed = compose(seen, between(poses[loops.newer], np.broadcast_to(poses[place], (len(seen), 3))))
    turn = np.median(wrap_angle(placed[:, 2] - poses[place, 2]))
    return compose(np.array([*np.median(placed[:, :2], axis=0), poses[place, 2] + turn]), inverse(poses[place]))


def loosened(graph: PoseGraph, poses: Array, place: int, motion: Array) -> PoseGraph:
    """The graph with the chain loosened before a node, and the nodes from there on moved by a transform (3,) of the map.

    One loose edge takes the place of the edges of motion that lead across; its number follows the highest.
    """
    moved = np.concatenate([poses[:place], compose(motion, poses[place:])])
    kept = graph.with_edges(~(graph.is_motion & leads_across(graph, place)))
    information = np.diag(1.0 / np.array([LOOSE_M, LOOSE_M, LOOSE_RAD]) ** 2)
    return replace(
        kept,
        initial=moved,
        sources=np.append(kept.sources, place - 1),
        targets=np.append(kept.targets, place),
        deltas=np.concatenate([kept.deltas, between(moved[place - 1], moved[place])[None]]),
        information=np.concatenate([kept.information, information[None]]),
        kinds=np.append(kept.kinds, np.int8(EdgeKind.REGISTRATION)),
        edge_ids=np.append(kept.edge_ids, graph.edge_ids.max() + 1),
        entered=None if kept.entered is None else np.append(kept.entered, graph.n_nodes - 1),
    )


@dataclass(frozen=True, slots=True)
class Freed:
    """What a solution with the chain loosened before a node changes.

    Attributes:
        loops: (F,) edge ids of the loops that were rejected and now fit.
        lost: number of loops that fitted and are now rejected, without those that are not `clear` (see `freed`).
        gain: fall of the cost: truncated for loops, whole for edges of motion.
        motion: (3,) how the node has moved on the map against the one before it, as a transform of the map, m and rad.
        pays: whether so many loops are freed at so little cost that the chain was wrong.
        straightens: whether loops that fit had bent the chain so much that as many freed ones would not lower the cost more.
    """

    loops: Indices
    lost: int
    gain: float
    motion: Array
    pays: bool
    straightens: bool


def freed(graph: PoseGraph, poses: Array, solved: Array, place: int, gate: float, clear: Mask) -> Freed:
    """Compare the solution with that of the graph whose chain is loosened before a node.

    Args:
        graph: the graph with its chain.
        poses: (N, 3) its solution, m and rad.
        solved: (N, 3) solution of the loosened graph.
        place: the node.
        gate: squared residual beyond which a loop is an outlier, at which its cost is truncated.
        clear: (E,) false for loops that are measured by views from both sides of the place. They fit neither map, and do not
            count if they are lost.
    """
    before, after = squared_norms(graph, poses), squared_norms(graph, solved)
    loops, across = graph.is_loop, leads_across(graph, place)
    motion_edges = graph.is_motion & ~across
    edges = np.flatnonzero(loops & (before > gate) & (after <= gate))
    lost = int(np.count_nonzero(loops & clear & (before <= gate) & (after > gate)))
    fall = np.minimum(before, gate) - np.minimum(after, gate)
    crossing = before[graph.is_motion & across].sum()
    counted = loops & (clear | (fall > 0.0))
    gain = float(fall[counted].sum() + (before - after)[motion_edges].sum() + crossing)
    expected = compose(solved[place - 1], between(poses[place - 1], poses[place]))
    motion = compose(solved[place], inverse(expected))
    worth = gain > GAIN * gate * len(edges) and len(edges) >= OUTWEIGHS * lost
    moved = moves(motion, poses, place)
    pays = bool(worth and is_group(graph, edges) and moved)
    bent = gain > GAIN * gate * max(LEAST_LOOPS, OUTWEIGHS * lost) and moved
    straightens = bool(bent and is_group(graph, np.flatnonzero(loops & across & (after <= gate))))
    return Freed(graph.edge_ids[edges], lost, gain, motion, pays, straightens)


def drove(wheels: Chain, loops: Loops, place: int, step: Array) -> bool:
    """Whether dead reckoning alone says that the robot drove to a node where loops want it carried there.

    Wheels feel no carry: after one, they are off by it until it is put into them. Where they are much farther off with it
    than without, the robot drove, and registrations are wrong. How large the noise of the wheels is does not count.

    Args:
        wheels: the chain of the odometry edges.
        loops: the loops that say that the robot was carried, each from before the node to after it.
        place: the node.
        step: (3,) its pose in the frame of the node before, with the carry, m and rad.
    """
    poses = wheels.poses.copy()
    poses[place:] = compose(compose(poses[place - 1], step), between(wheels.poses[place], wheels.poses[place:]))
    without, carried = (np.median(_off(replace(wheels, poses=way), loops)) for way in (wheels.poses, poses))
    return bool(np.isfinite(without) and carried > FARTHER**2 * without)


def _off(wheels: Chain, loops: Loops) -> Array:
    """Squared Mahalanobis distance (L,) of the loops from a chain; infinite across its breaks."""
    ways = wheels.ways(loops.older, loops.newer)
    return Ring(log(between(ways.delta, loops.relative.delta)), ways.covariance + loops.relative.covariance).distance
