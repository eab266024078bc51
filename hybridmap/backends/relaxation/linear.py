"""The paper's correction rule (its equation 16) as printed, and a variant with the rate divided by each node's degree.

Both keep the transitions in the world frame of the initial chain, so headings stay those of odometry. All nodes are
corrected at once: a Jacobi step d += theta (b - L d), L the graph's Laplacian, stable only for theta < 2 / lambda_max(L).
The variant is stable for every theta <= 1, as no eigenvalue of D^-1 L is above 2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import eigsh

from hybridmap.backends.base import Outcome, SolveStatus
from hybridmap.backends.driver import Driver
from hybridmap.backends.relaxation.ratslam import TOLERANCE_M, relaxing
from hybridmap.config.backends import BackendsConfig, RelaxationConfig
from hybridmap.errors import counted
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_CHECK_EVERY = 50  # sweeps between two looks at the objective

Rate = tuple[float | Array | None, str]
"""The rate of each node, or None to refuse; and a word about it."""


@dataclass(frozen=True, slots=True)
class LinearRule:
    """The paper's rule on one graph of N nodes and E edges; it moves positions only.

    Attributes:
        sources, targets: (E,) nodes of each edge.
        transitions: (E, 2) displacement of each edge in the world frame, m.
        laplacian: (N, N) sparse graph Laplacian, every edge of weight one.
        pull: (N, 2) constant part of the correction, m: the correction is `pull` minus `laplacian` times positions.
        degree: (N,) number of edges of each node.
    """

    sources: NDArray[np.int64]
    targets: NDArray[np.int64]
    transitions: Array
    laplacian: csr_array
    pull: Array
    degree: Array

    @classmethod
    def of(cls, graph: PoseGraph) -> LinearRule:
        """Make the rule for a graph; transitions are turned to the world frame by the headings of its `initial`."""
        yaw = graph.initial[graph.sources, 2]
        cos, sin = np.cos(yaw), np.sin(yaw)
        dx, dy = graph.deltas[:, 0], graph.deltas[:, 1]
        transitions = np.column_stack([cos * dx - sin * dy, sin * dx + cos * dy])
        n, e = graph.n_nodes, graph.n_edges
        links = np.arange(e)
        ends = np.concatenate([graph.targets, graph.sources])
        signs = np.concatenate([np.ones(e), -np.ones(e)])
        incidence = csr_array((signs, (ends, np.tile(links, 2))), shape=(n, e))
        laplacian = csr_array(incidence @ incidence.T)
        degree = np.bincount(ends, minlength=n).astype(np.float64)
        return cls(graph.sources, graph.targets, transitions, laplacian, incidence @ transitions, degree)

    def correction(self, positions: Array) -> Array:
        """Correction of all nodes, (N, 2) m, before it is multiplied by the rate: the bracket of the paper's equation 16."""
        return np.asarray(self.pull - self.laplacian @ positions)

    def objective(self, positions: Array) -> float:
        """Half the sum of squared errors of the edges, m^2, which the rule minimises."""
        error = positions[self.targets] - positions[self.sources] - self.transitions
        return 0.5 * float(np.sum(error * error))


def lambda_max(laplacian: csr_array) -> float:
    """Largest eigenvalue of a graph Laplacian; the rule is stable for rates below 2 / lambda_max."""
    n = laplacian.shape[0]
    if n <= 16:
        return float(np.linalg.eigvalsh(laplacian.toarray())[-1])
    start = np.where(np.arange(n) % 2 == 0, 1.0, -1.0) + np.cos(np.arange(n))  # fixed, so that runs agree to the bit
    return float(eigsh(laplacian, k=1, which="LA", v0=start, tol=1e-6, return_eigenvectors=False)[0])


def relax(rule: LinearRule, positions: Array, rate: float | Array, sweeps: int, tolerance_m: float) -> tuple[Array | None, int]:
    """Run up to `sweeps` sweeps of positions += rate * correction; returns the positions and the number of sweeps.

    The positions are None if they grew without bound. The run ends early once no node moves by more than `tolerance_m`.

    Args:
        rule: the correction.
        positions: (N, 2) initial positions, m; they are not changed.
        rate: one for all nodes, or (N, 1).
        sweeps: most sweeps.
        tolerance_m: largest step of a coordinate, m, that ends the run.
    """
    before = rule.objective(positions)
    with np.errstate(over="ignore", invalid="ignore"):
        for done in range(1, sweeps + 1):
            step = rate * rule.correction(positions)
            positions = positions + step
            largest = np.abs(step).max()
            if largest <= tolerance_m:
                return positions, done
            if (done % _CHECK_EVERY == 0 or done == sweeps) and not rule.objective(positions) <= 1.000001 * before + 1e-12:
                return None, done
    return positions, sweeps


def paper(name: str, config: BackendsConfig) -> Driver:
    """A back-end with the paper's equation 16 as printed; `on_unstable` configures what happens if its rate is too large."""

    def rate(rule: LinearRule, config: RelaxationConfig) -> Rate:
        largest = lambda_max(rule.laplacian)
        theta_max = 2.0 / largest if largest > 0.0 else np.inf
        note = f"theta {config.theta}, theta_max {theta_max:.4g} = 2/lambda_max, lambda_max {largest:.4g}"
        if config.theta < theta_max or config.on_unstable == "run":
            return config.theta, note
        return (_by_degree(rule, config), f"{note}, normalised") if config.on_unstable == "normalise" else (None, note)

    return relaxing(name, config, partial(_relaxed, config.relaxation, rate))


def normalised(name: str, config: BackendsConfig) -> Driver:
    """A back-end with equation 16 and theta divided by the node's degree; a sweep never increases its objective."""

    def rate(rule: LinearRule, config: RelaxationConfig) -> Rate:
        return _by_degree(rule, config), f"theta {config.theta} / degree"

    return relaxing(name, config, partial(_relaxed, config.relaxation, rate))


def _relaxed(
    config: RelaxationConfig,
    rate_of: Callable[[LinearRule, RelaxationConfig], Rate],
    graph: PoseGraph,
    start: Array,
    sweeps: int,
) -> Outcome:
    """Sweeps over positions alone, with a rate per node."""
    rule = LinearRule.of(graph)
    rate, note = rate_of(rule, config)
    if rate is None:
        return Outcome(start, SolveStatus.DIVERGED, f"{note}; not run", 0)
    positions, done = relax(rule, start[:, :2], rate, sweeps, TOLERANCE_M)
    if positions is None:
        return Outcome(
            start, SolveStatus.DIVERGED, f"{note}; diverged within {counted(done, 'sweep')}; the initial poses are kept", done
        )
    poses = np.column_stack([positions, graph.initial[:, 2]])
    status = SolveStatus.CONVERGED if done < sweeps else SolveStatus.MAX_ITERATIONS
    return Outcome(poses, status, f"{note}; {counted(done, 'sweep')}", done)


def _by_degree(rule: LinearRule, config: RelaxationConfig) -> Array:
    return np.asarray((config.theta / np.maximum(rule.degree, 1.0))[:, None])
