"""Relaxation link by link, in place, headings too: the rule of RatSLAM's experience map, without a loop over links.

A sweep visits the links in order; each moves its two ends towards each other by theta times its error. Correcting
headings is linear, and so are positions once the heading of each link's source *at the time of its visit* is known. A
sequential sweep over links of a linear system is the triangular solve (D + L) c = error with D + L the lower part of
theta * A A', A the incidence matrix: one sparse solve for headings, one for positions, equal to the loop to rounding (an
error that would wrap past +-pi in the middle of a sweep is wrapped at its start).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, eye_array, tril
from scipy.sparse.linalg import splu

from hybridmap.backends.base import Solution, SolveStatus
from hybridmap.backends.following import Change, GraphBackend, Outcome
from hybridmap.geometry import Array, wrap_angle
from hybridmap.graph.pose_graph import PoseGraph


class LinkSweep:
    """One graph's links, prepared for sweeps at a given theta."""

    def __init__(self, graph: PoseGraph, theta: float) -> None:
        order = link_order(graph)
        self.sources, self.targets = graph.sources[order], graph.targets[order]
        self.deltas = graph.deltas[order]
        n, e = graph.n_nodes, graph.n_edges
        links = np.arange(e)
        signs = np.concatenate([np.ones(e), -np.ones(e)])
        # A link's unit correction moves its source by +1 and its target by -1.
        moves = coo_array((signs, (np.concatenate([self.sources, self.targets]), np.tile(links, 2))), shape=(n, e)).tocsr()
        self._moves = moves
        gram = (moves.T @ moves).tocsr()
        lower = (tril(gram, k=-1) * theta + eye_array(e)).tocsc()
        self._lower = splu(lower, permc_spec="NATURAL", diag_pivot_thresh=0.0)
        at_source = csr_array(moves[self.sources])
        self._earlier = csr_array(tril(at_source, k=-1))
        self._theta = theta

    def __call__(self, poses: Array) -> Array:
        """Visit every link once; (N, 3)."""
        yaw, position = poses[:, 2], poses[:, :2]
        error = wrap_angle(yaw[self.targets] - yaw[self.sources] - self.deltas[:, 2])
        turn = self._theta * self._lower.solve(error)
        heading = yaw[self.sources] + self._earlier @ turn
        cos, sin = np.cos(heading), np.sin(heading)
        dx, dy = self.deltas[:, 0], self.deltas[:, 1]
        step = np.column_stack([cos * dx - sin * dy, sin * dx + cos * dy])
        apart = position[self.targets] - position[self.sources] - step
        shift = self._theta * self._lower.solve(apart)
        return np.column_stack([position + self._moves @ shift, wrap_angle(yaw + self._moves @ turn)])


class RatslamRelaxation(GraphBackend):
    """`relaxation-ratslam`: some sweeps whenever the graph has grown."""

    def finish(self, graph: PoseGraph) -> Solution:
        """See `Backend.finish`: the sweeps of one more update; the state is the map."""
        return self.update(graph)

    def _must_work(self, change: Change) -> bool:
        del change
        return True

    def _follow(self, graph: PoseGraph, start: Array, change: Change) -> Outcome:
        del change
        return self._sweep(graph, start, self._config.relaxation.sweeps_per_node)

    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        return self._sweep(graph, start, self._config.relaxation.solve_sweeps)

    def _sweep(self, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        config = self._config.relaxation
        if graph.n_edges == 0:
            return Outcome(start, SolveStatus.CONVERGED, "nothing to relax", 0)
        poses, theta = start, config.theta
        sweep = LinkSweep(graph, theta)
        for done in range(1, sweeps + 1):
            moved = sweep(poses)
            largest = _largest_move(poses, moved)
            if not np.isfinite(moved).all():
                return Outcome(start, SolveStatus.DIVERGED, f"theta {theta}: poses were not finite", done)
            poses = moved
            if largest <= config.tolerance_m:
                return Outcome(poses, SolveStatus.CONVERGED, f"no node moved more than {config.tolerance_m} m", done)
            if config.theta_decay < 1.0:
                theta *= config.theta_decay
                sweep = LinkSweep(graph, theta)
        return Outcome(poses, SolveStatus.MAX_ITERATIONS, f"{sweeps} sweeps", sweeps)


def _largest_move(before: Array, after: Array) -> float:
    step = after - before
    step[:, 2] = wrap_angle(step[:, 2])
    return float(np.abs(step).max())


def link_order(graph: PoseGraph) -> NDArray[np.int64]:
    """The order in which a sweep visits the links: by source node, then by age."""
    return np.lexsort((graph.edge_ids, graph.sources))
