"""A back-end with the systematic errors of odometry (gain, turn gain, heading bias) as variables of the graph.

A heading bias bends every metre by the same amount. No robust kernel removes that: true loops that contradict the bent
chain are rejected instead. Estimating the bias straightens the whole chain. A wrong winding of the chain is a local
minimum, so the solver runs from several initial biases. The result with the lowest truncated cost is taken: chi2 in which a
rejected loop counts as much as one at the limit of rejection.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybridmap.backends.base import Outcome
from hybridmap.backends.driver import Driver
from hybridmap.backends.gtsam import gnc
from hybridmap.backends.gtsam.batch import run
from hybridmap.backends.gtsam.covariance import Covariances
from hybridmap.backends.gtsam.factors import factor_graph, noise_models
from hybridmap.backends.judging.clusters import rejected_clusters
from hybridmap.backends.objective import gate_of, residuals, softened, truncated_cost
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError, counted
from hybridmap.geometry import Array, adjoint, between, log
from hybridmap.graph.paths import own_odometry
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.odometry_model import NEUTRAL, Gains, apply

BIAS_STARTS_RAD_M = (0.0, -0.02, 0.02, -0.06, 0.06)
"""Starts of the heading bias, rad/m; the drift of wheels seldom exceeds 3 deg/m."""

_NEUTRAL = NEUTRAL.to_array()
_PRIOR_SIGMA = np.array([0.02, 0.1, 0.2])  # so wide that it only holds what the drive leaves open, such as its scale
_ROUNDS = 12
_SETTLED = 1e-6
_SAME = 2e-4  # by how much the calibrations of two starts may differ to be one
_STEP = 1e-6  # of the difference that takes a derivative by the calibration


@dataclass(frozen=True, slots=True)
class _Found:
    """Result of one start: `graph` has calibrated odometry, `gains` (3,) are gain, turn gain, heading bias."""

    graph: PoseGraph
    outcome: Outcome
    gains: Array
    cost: float


def with_calibrated_odometry(graph: PoseGraph, gains: Gains) -> PoseGraph:
    """Copy of the graph with the odometry edges from a node to the next calibrated; other edges stay.

    Their noise grows with the gains; otherwise a smaller map would always fit better.
    """
    own = own_odometry(graph)
    deltas, information = graph.deltas.copy(), graph.information.copy()
    deltas[own] = apply(deltas[own], gains)
    shrink = 1.0 / np.array([gains.gain, gains.gain, gains.turn_gain])
    information[own] *= shrink[:, None] * shrink
    return replace(graph, deltas=deltas, information=information)


def create(name: str, config: BackendsConfig) -> Driver:
    """A back-end with Cauchy's kernel on loops while driving; it calibrates odometry when it solves a whole graph."""
    return gnc.create(name, config, best)


def best(graph: PoseGraph, config: BackendsConfig, driven: Array | None) -> Outcome:
    """Solve with several initial heading biases; returns the solution with the lowest truncated cost.

    It stops early if two of them agree and no rejected loops agree with each other.

    Args:
        graph: the graph, with uncalibrated odometry.
        config: settings of the back-end.
        driven: (N, 3) poses reached while driving, as a further start; None if there are none.
    """
    found: list[_Found] = []
    for bias in BIAS_STARTS_RAD_M:
        one = _from(graph, config, np.array([1.0, 1.0, bias]), driven if bias == 0.0 else None)
        agrees = any(np.abs(one.gains - other.gains).max() < _SAME for other in found)
        found.append(one)
        if agrees and not rejected_clusters(one.graph, one.outcome.poses, one.outcome.rejected, gate_of(config)):
            break
    chosen = min(found, key=lambda each: each.cost)
    gain, turn_gain, bias = chosen.gains
    message = f"gain {gain:.4f}, turn gain {turn_gain:.4f}, heading bias {bias:.5f} rad/m from {counted(len(found), 'start')}"
    return replace(chosen.outcome, message=f"{message}; {chosen.outcome.message}", calibrated=chosen.graph)


def _from(graph: PoseGraph, config: BackendsConfig, gains: Array, driven: Array | None) -> _Found:
    """Alternate between choosing loops and calibrating until neither changes."""
    straight = with_calibrated_odometry(graph, Gains.from_array(gains))
    outcome = gnc.best(straight, config, driven)
    for _ in range(3):
        before = outcome.rejected
        gains, poses = calibrate(graph.with_edges(~np.isin(graph.edge_ids, before)), gains, outcome.poses, config)
        straight = with_calibrated_odometry(graph, Gains.from_array(gains))
        outcome = gnc.best(straight, config, poses)
        if outcome.rejected == before:
            break
    cost = truncated_cost(straight, outcome.poses, gate_of(config), config.robust)
    return _Found(straight, outcome, gains, cost)


def calibrate(graph: PoseGraph, gains: Array, poses: Array, config: BackendsConfig) -> tuple[Array, Array]:
    """Gauss-Newton on the three gains, with the optimal poses at each step.

    Args:
        graph: uncalibrated odometry, and the edges that are held for right.
        gains: (3,) gain, turn gain and heading bias to begin with.
        poses: (N, 3) poses to begin with, m and rad.
        config: settings of the robust kernels, and the most iterations for the poses.

    Returns:
        The gains (3,) and the poses (N, 3) that belong to them.
    """
    models = noise_models(config.robust)
    for _ in range(_ROUNDS):
        straight = with_calibrated_odometry(graph, Gains.from_array(gains))
        poses = run("lm", factor_graph(straight, models), poses, config.max_iterations).poses
        try:
            step = _gain_step(graph, softened(straight, poses, config.robust), poses, gains)
        except (BackendError, np.linalg.LinAlgError):  # singular: nothing tells the gains from the poses
            break
        if not np.isfinite(step).all():
            break
        gains = gains + step
        if np.abs(step).max() < _SETTLED:
            break
    return gains, poses


def _gain_step(raw: PoseGraph, straight: PoseGraph, poses: Array, gains: Array) -> Array:
    """Step (3,) of the calibration with the poses eliminated (a Schur complement)."""
    own = own_odometry(raw)
    slope = np.stack([_slope(raw.deltas[own], straight.deltas[own], gains, k) for k in range(3)], axis=2)  # (O, 3, 3)
    r, information = residuals(straight, poses), straight.information
    slope[:, :2, 0] -= r[own, :2] / gains[0]
    slope[:, 2, 1] -= r[own, 2] / gains[1]
    s, t = straight.sources, straight.targets
    carried = -adjoint(between(poses[t], poses[s])).transpose(0, 2, 1)
    wide = np.zeros((straight.n_nodes, 3, 4))  # columns: by each of the three numbers, and the gradient
    np.add.at(wide, s[own], np.concatenate([carried[own] @ information[own] @ slope, np.zeros((len(own), 3, 1))], axis=2))
    np.add.at(wide, t[own], np.concatenate([information[own] @ slope, np.zeros((len(own), 3, 1))], axis=2))
    pull = (information @ r[:, :, None])[:, :, 0]
    np.add.at(wide[:, :, 3], s, (carried @ pull[:, :, None])[:, :, 0])
    np.add.at(wide[:, :, 3], t, pull)
    columns = wide.reshape(-1, 4)[3:]
    solved = Covariances(straight, poses).solve(columns)
    own_part = np.einsum("eik,eij,ejl->kl", slope, information[own], slope) + np.diag(_PRIOR_SIGMA**-2.0)
    reduced = own_part - columns[:, :3].T @ solved[:, :3]
    gradient = np.einsum("eik,ei->k", slope, pull[own]) + (gains - _NEUTRAL) / _PRIOR_SIGMA**2
    return np.asarray(-np.linalg.solve(reduced, gradient - columns[:, :3].T @ solved[:, 3]))


def _slope(raw: Array, straight: Array, gains: Array, number: int) -> Array:
    """Derivative (O, 3) of the residuals of odometry edges by one of the three gains."""
    moved = gains.copy()
    moved[number] += _STEP
    return np.asarray(-log(between(straight, apply(raw, Gains.from_array(moved)))) / _STEP)
