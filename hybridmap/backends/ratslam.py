"""Relaxation link by link, in place, headings too: the rule of RatSLAM's experience map, plain and robust."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridmap.backends.base import Solution, SolveStatus
from hybridmap.backends.following import Outcome
from hybridmap.backends.link_blocks import BlockSweeps, Relaxed, affordable
from hybridmap.backends.links import Complex, Links, Planar
from hybridmap.backends.objective import gate_of, truncated_cost
from hybridmap.backends.relaxing import RelaxationBackend
from hybridmap.config.backends import RelaxationConfig
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_WORTH_PREPARING = 100  # sweeps from which the matrices of a block pay
_REJECTED = 0.25  # weight of a loop whose residual is the scale itself


class RatslamRelaxation(RelaxationBackend):
    """`relaxation-ratslam`: every link moves both of its ends by theta times its error."""

    def _relax(self, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        relaxed = relax_links(Links.of(graph), Planar.of(start), sweeps, self._config.relaxation)
        return _outcome(relaxed, self._config.relaxation)


def relax_links(links: Links, poses: Planar, sweeps: int, config: RelaxationConfig) -> Relaxed:
    """At most so many sweeps of the plain rule, by whichever way is the quicker."""
    n_nodes = len(poses.yaw)
    if config.theta_decay == 1.0 and sweeps >= _WORTH_PREPARING and affordable(links, n_nodes):
        return BlockSweeps(links, n_nodes, config.theta).run(poses, sweeps, config.tolerance_m)
    theta = config.theta
    for done in range(1, sweeps + 1):
        moved = links.sweep(poses, theta)
        largest = moved.largest_move(poses)
        poses = moved
        if largest <= config.tolerance_m or not np.isfinite(largest):
            return Relaxed(poses, done, settled=bool(largest <= config.tolerance_m))
        theta *= config.theta_decay
    return Relaxed(poses, sweeps, settled=False)


def _outcome(relaxed: Relaxed, config: RelaxationConfig) -> Outcome:
    poses = relaxed.poses.to_array()
    if relaxed.settled:
        return Outcome(poses, SolveStatus.CONVERGED, f"no node moved more than {config.tolerance_m} m", relaxed.sweeps)
    return Outcome(poses, SolveStatus.MAX_ITERATIONS, f"{relaxed.sweeps} sweeps", relaxed.sweeps)


class RobustRelaxation(RelaxationBackend):
    """`relaxation-robust`: a loop's correction is multiplied by a Geman-McClure weight of its error.

    The scale of the weight shrinks geometrically to 1 in the course of a call. When a whole graph is solved, that takes a
    quarter of the sweeps; the rest are of the plain rule on the loops that are left, with a look at all of them in between.
    The end of a drive is solved as a whole from the map that the drive led to, and the better of the two is kept.
    """

    def finish(self, graph: PoseGraph) -> Solution:
        """See `Backend.finish`."""
        driven = self.update(graph)
        settled = self._timed(graph, lambda: self._optimise(graph, driven.poses))
        bound = gate_of(self._config)
        return min(settled, driven, key=lambda solution: truncated_cost(graph, solution.poses, bound))

    def _relax(self, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        config = self._config.relaxation
        links = Links.of(graph)
        done = min(sweeps, max(sweeps // 4, 1))
        relaxed = Relaxed(_annealed(graph, links, Planar.of(start), done, config), done, settled=False)
        while relaxed.sweeps < sweeps and not relaxed.settled:
            kept = ~(graph.is_loop & (_weights(graph, links, relaxed.poses, config) < _REJECTED))
            part = min(max(sweeps // 4, 1), sweeps - relaxed.sweeps)
            onward = relax_links(Links.of(graph.with_edges(kept)), relaxed.poses, part, config)
            relaxed = replace(onward, sweeps=relaxed.sweeps + onward.sweeps)
        return _judged(graph, links, relaxed, config)

    def _relax_on(self, graph: PoseGraph, start: Array, sweeps: int) -> Outcome:
        config = self._config.relaxation
        links = Links.of(graph)
        poses = _annealed(graph, links, Planar.of(start), sweeps, config)
        return _judged(graph, links, Relaxed(poses, sweeps, settled=False), config)


def _annealed(graph: PoseGraph, links: Links, poses: Planar, sweeps: int, config: RelaxationConfig) -> Planar:
    """Weighted sweeps while the scale shrinks from `robust_start` to 1, which it is in the second half."""
    loop = graph.is_loop[links.order]
    for sweep in range(1, sweeps + 1):
        scale = config.robust_start ** max(0.0, 1.0 - 2.0 * sweep / sweeps)

        def weigh(level: slice, apart: Complex, turn: Array, scale: float = scale) -> Array:
            return np.where(loop[level], geman_mcclure(apart, turn, config, scale), 1.0)

        poses = links.sweep(poses, config.theta, weigh)
    return poses


def _judged(graph: PoseGraph, links: Links, relaxed: Relaxed, config: RelaxationConfig) -> Outcome:
    """The outcome with every loop's weight, those of less than `_REJECTED` as rejected."""
    weights = _weights(graph, links, relaxed.poses, config)[graph.is_loop]
    by_id = dict(zip(graph.edge_ids[graph.is_loop].tolist(), weights.tolist(), strict=True))
    rejected = tuple(edge for edge, weight in by_id.items() if weight < _REJECTED)
    outcome = _outcome(relaxed, config)
    message = f"{outcome.message}; {len(rejected)} of {len(by_id)} loops rejected"
    return replace(outcome, message=message, weights=by_id, rejected=rejected)


def geman_mcclure(apart: Complex, turn: Array, config: RelaxationConfig, scale: float) -> Array:
    """Weights (E,) 1 / (1 + r^2)^2 of errors (m, rad), r^2 the sum of squares in units of the scaled robust scales."""
    metres, radians = scale * config.robust_scale_m, scale * config.robust_scale_rad
    squared = (apart.real**2 + apart.imag**2) / metres**2 + turn**2 / radians**2
    return np.asarray(1.0 / (1.0 + squared) ** 2)


def _weights(graph: PoseGraph, links: Links, poses: Planar, config: RelaxationConfig) -> Array:
    """Weight (E,) that each edge of the graph would have as a loop, at the scale itself."""
    out = np.empty(graph.n_edges)
    out[links.order] = geman_mcclure(*links.errors(poses, slice(None)), config, 1.0)
    return out
