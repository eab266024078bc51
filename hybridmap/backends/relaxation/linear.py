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
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import eigsh

from hybridmap.backends.base import Outcome, SolveStatus
from hybridmap.backends.driver import Driver
from hybridmap.backends.relaxation.ratslam import TOLERANCE_M, relaxing
from hybridmap.config.backends import BackendsConfig, RelaxationConfig
from hybridmap.errors import counted
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_DENSE = 400  # nodes up to which all eigenvalues are computed at once
_TRIAL_SWEEPS = 1000  # after which the fastest growing mode of a graph of some hundred nodes outweighs the others
_LONG_SWEEPS = 3000  # after which its slowest one does
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


@dataclass(frozen=True, slots=True)
class Spectrum:
    """What decides how a linear rule converges: eigenvalues of its rate per theta times the Laplacian.

    Attributes:
        second: the smallest one above zero, lambda_2: of the slowest way in which the map bends. 0 for a graph in parts.
        largest: lambda_max.
    """

    second: float
    largest: float

    @classmethod
    def of(cls, rule: LinearRule, scale: Array) -> Spectrum:
        """The spectrum of a rule whose node i has the rate theta times scale[i], (N,); N is 2 or more."""
        root = diags_array(np.sqrt(scale))
        alike = csr_array(root @ rule.laplacian @ root)  # symmetric, with the eigenvalues of scale times the Laplacian
        n = alike.shape[0]
        if n <= _DENSE:
            values = np.linalg.eigvalsh(alike.toarray())
            return cls(max(float(values[1]), 0.0), float(values[-1]))
        start = np.cos(np.arange(n))  # fixed, so that runs agree to the bit
        near = -1e-3 * lambda_max(alike) / n**2  # a little below zero, where the matrix can be factorised
        low = eigsh(alike.tocsc(), k=2, sigma=near, which="LM", v0=start, return_eigenvectors=False)
        return cls(max(float(low.max()), 0.0), lambda_max(alike))

    @property
    def theta_max(self) -> float:
        """The rate from which the rule diverges."""
        return 2.0 / self.largest if self.largest > 0.0 else np.inf

    def factor(self, theta: float) -> float:
        """Factor of a sweep on the error in the long run: 1 - theta lambda_2, or that of the largest one where it is more."""
        return max(abs(1.0 - theta * self.second), abs(1.0 - theta * self.largest))


def measured_factor(rule: LinearRule, positions: Array, rate: Array, sweeps: int) -> float:
    """By what the correction shrinks a sweep, measured: the mean over the last tenth of these sweeps.

    NaN if there is nothing to correct.

    Args:
        rule: the correction.
        positions: (N, 2) where to begin, m.
        rate: (N,) rate of each node.
        sweeps: number of sweeps; the slowest mode must have outlived the others by then.
    """
    each, still = rate[:, None], (1.0 / rate)[:, None] / np.sum(1.0 / rate)  # no sweep moves this mean of all nodes
    step, sizes = each * rule.correction(positions), []
    for _ in range(sweeps):
        step = step - np.sum(still * step, axis=0)  # which rounding would let outlive every mode
        sizes.append(float(np.linalg.norm(step)))
        if not 0.0 < sizes[-1] < np.inf:
            return np.nan
        step = step / sizes[-1]  # of length one, so that nothing overflows
        step = step - each * (rule.laplacian @ step)
    return float(np.exp(np.mean(np.log(sizes[-max(sweeps // 10, 1) :]))))


def measured_theta_max(rule: LinearRule, positions: Array, scale: Array, sweeps: int) -> float:
    """The rate theta from which the corrections grow, measured to a thousandth by halving an interval.

    Args:
        rule: the correction.
        positions: (N, 2) where to begin, m.
        scale: (N,) rate of each node per theta.
        sweeps: of each trial; NaN is returned where nothing is to be corrected.
    """
    if not np.isfinite(measured_factor(rule, positions, scale, sweeps)):
        return np.nan
    low, high = 0.0, 4.0 / float(np.max(scale * rule.degree))  # lambda_max is not below this entry of the diagonal
    while high - low > 1e-3 * high:
        middle = 0.5 * (low + high)
        grows = measured_factor(rule, positions, middle * scale, sweeps) > 1.0
        low, high = (low, middle) if grows else (middle, high)
    return 0.5 * (low + high)


def convergence(name: str, graph: PoseGraph, theta: float) -> dict[str, float]:
    """Figures of how the back-end `name` converges on a graph from its `initial`; empty if it is none of this module's.

    `theta_max` and `shrinks` are predicted from eigenvalues (`Spectrum`); `theta_max_measured` and `shrinks_measured` are what
    sweeps do.
    """
    if name not in _SCALES or graph.n_nodes < 2 or graph.n_edges == 0:
        return {}
    rule = LinearRule.of(graph)
    scale, positions = _SCALES[name](rule), graph.initial[:, :2]
    spectrum = Spectrum.of(rule, scale)
    return {
        "theta_max": spectrum.theta_max,
        "theta_max_measured": measured_theta_max(rule, positions, scale, _TRIAL_SWEEPS),
        "shrinks": spectrum.factor(theta),
        "shrinks_measured": measured_factor(rule, positions, theta * scale, _LONG_SWEEPS),
    }


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


_SCALES: dict[str, Callable[[LinearRule], Array]] = {
    "relaxation-paper": lambda rule: np.ones(len(rule.degree)),
    "relaxation-normalised": lambda rule: 1.0 / np.maximum(rule.degree, 1.0),
}
"""Back-end -> rate of each node (N,) per theta."""


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
    return (config.theta * _SCALES["relaxation-normalised"](rule))[:, None]
