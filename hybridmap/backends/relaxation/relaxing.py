"""The common part of relaxation back-ends: sweeps after each growth of the graph, with the map as the only state."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hybridmap.backends.base import Outcome, Solver, SolveStatus
from hybridmap.backends.driver import Driver, Works
from hybridmap.config.backends import BackendsConfig
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

TOLERANCE_M = 1e-6
"""A sweep that moves no node by more (m; 1 rad counts as 1 m) ends the relaxation: far below the noise of any edge."""

Rule = Callable[[PoseGraph, Array, int], Outcome]
"""At most so many sweeps over a graph that has edges, from poses (N, 3)."""


def swept(rule: Rule, sweeps: int) -> Solver:
    """Make a solver that runs up to this many sweeps of a relaxation rule; poses that grow without bound are refused."""

    def solve(graph: PoseGraph, start: Array) -> Outcome:
        if graph.n_edges == 0:
            return Outcome(start, SolveStatus.CONVERGED, "nothing to relax", 0)
        with np.errstate(over="ignore", invalid="ignore"):
            outcome = rule(graph, start, sweeps)
        if np.isfinite(outcome.poses).all():
            return outcome
        return Outcome(start, SolveStatus.DIVERGED, "poses were not finite; kept those before", outcome.iterations)

    return solve


def relaxing(name: str, config: BackendsConfig, rule: Rule) -> Driver:
    """A back-end that runs sweeps of `rule` whenever the graph grows; the end of the drive is one more such update."""
    follow = swept(rule, config.relaxation.sweeps_per_node)
    solve = swept(rule, config.relaxation.solve_sweeps)
    return Driver(name, config, solve, follow=follow, last=follow, works=Works.ON_GROWTH)
