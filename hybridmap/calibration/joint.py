"""Joint calibration: gain, turn gain, heading bias and delay as one more variable of the GTSAM graph.

A heading bias is in every odometry edge, so no robust kernel removes it. As a variable it bends the whole chain, so that
loops that contradict a drifted chain fit again. The problem has local minima (other winding numbers of the chain), so
several initial biases are tried, each from poses grown by incremental relaxation along the chain made with that bias.
The lowest objective wins. The odometry part of the objective alone would not suffice: it is small for a map shrunk to a point.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from hybridmap import backends
from hybridmap.backends.gtsam.factors import NoiseModels, anchor, collected, factors, poses_of, values
from hybridmap.backends.objective import squared_norms
from hybridmap.backends.registry import RELAXATION
from hybridmap.calibration.estimate import Estimate
from hybridmap.calibration.legs import Motion, corrected
from hybridmap.calibration.odometry_terms import OdometryTerms, terms_of
from hybridmap.calibration.regression import CAUCHY, NotToldError, Sighting, require_delay, require_told_by
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError
from hybridmap.geometry import Array, between, compose, inverse
from hybridmap.graph.paths import chain, own_odometry
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.odometry_model import NEUTRAL, Gains

BIAS_STARTS_RAD_M = (0.0, -0.02, 0.02, -0.06, 0.06, -0.12, 0.12)
"""Starts of the heading bias, rad/m; the drift of wheels seldom exceeds 3 deg/m."""

PRIOR = np.array([0.2, 0.2, 0.2, 0.2])
"""Standard deviations before the drive of gain, turn gain, heading bias (rad/m) and delay (s): so wide that they hold only
what the drive leaves open."""

_AGREEING_STARTS = 5
_SAME_RAD_M = 2e-4
_OPEN_WAY = 0.1  # share of the way that only odometry spans; below it no winding of the chain is in doubt
_OPEN = 0.5  # of the prior's variance that is left: above it, the prior says more than the drive does
_HELD = 3  # edges besides odometry: nine equations for four unknowns
_NEUTRAL = np.append(NEUTRAL.to_array(), 0.0)
_ITERATIONS = 60
_MEDIAN_OF_NORM = {2: 1.1774, 3: 1.5382}  # median of the norm of so many standard normal components
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Joint:
    """A map and the calibration estimated with it.

    Attributes:
        poses: (N, 3) poses of the nodes, m and rad.
        estimate: the calibration.
        cost: value of the robust objective, the lowest over all initial biases that were tried.
        bias_start_rad_m: initial heading bias that led to this solution, rad/m.
    """

    poses: Array
    estimate: Estimate
    cost: float
    bias_start_rad_m: float


def solve(graph: PoseGraph, motion: Motion, stamps_ns: NDArray[np.int64], config: BackendsConfig) -> Joint:
    """Optimise poses and calibration together.

    Args:
        graph: nodes and accepted edges.
        motion: raw odometry.
        stamps_ns: (N,) stamps of the nodes.
        config: settings of the relaxation and the robust kernels.

    Raises:
        EvaluationError: turn gain and heading bias are unobservable, or the result is out of range.
        BackendError: GTSAM failed from every initial bias.
    """
    require_told_by(Sighting(motion, stamps_ns, graph.initial))
    problem = Problem(graph, motion, stamps_ns, config)
    found: list[Joint] = []
    for bias in BIAS_STARTS_RAD_M if problem.open_way() > _OPEN_WAY else BIAS_STARTS_RAD_M[:1]:
        start = Gains(heading_bias_rad_m=bias)
        solution = problem.solve(problem.grown(start), np.append(start.to_array(), 0.0), 1.0, bias)
        if solution is None:
            continue
        found.append(solution)
        reached = solution.estimate.gains.heading_bias_rad_m
        _logger.info("from %.3f rad/m: %.4f rad/m, cost %.2f", bias, reached, solution.cost)
        if len(found) == _AGREEING_STARTS and np.ptp([one.estimate.gains.heading_bias_rad_m for one in found]) < _SAME_RAD_M:
            break  # the starts on either side of zero lead to the same map
    if not found:
        raise BackendError("calibration: GTSAM failed from every initial heading bias; use `alternating` or a reference")
    best = min(found, key=lambda one: one.cost)
    variable = np.append(best.estimate.gains.to_array(), best.estimate.delay_s)
    scale = problem.scale(best.poses, variable)
    final = problem.solve(best.poses, variable, scale, best.bias_start_rad_m) or best
    problem.require_held(final.poses)
    return replace(final, estimate=told_by_the_drive(final.estimate))


def told_by_the_drive(estimate: Estimate) -> Estimate:
    """Return an estimate without the values about which the drive says less than the prior (`PRIOR`) does.

    That is where more than half of the prior's variance is left. Of the distance gain and the delay, such a value becomes
    neutral (1, 0 s) with infinite variance. The turn gain and the heading bias cannot be left out.

    Raises:
        NotToldError: more than half of the prior's variance of the turn gain or the heading bias is left.
        EvaluationError: the delay is beyond `DELAY_LIMIT_S`, or a gain is outside the limits of a configuration.
    """
    open_ = np.diag(estimate.covariance) > _OPEN * estimate.unit_variance * PRIOR**2
    if open_[1] or open_[2]:
        raise NotToldError(
            "calibration: the drive says too little about turn gain or heading bias; "
            "expected a drive that turns and closes loops"
        )
    values = np.where(open_, _NEUTRAL, np.append(estimate.gains.to_array(), estimate.delay_s))
    covariance = np.where(open_[:, None] | open_[None, :], 0.0, estimate.covariance)
    covariance[open_, open_] = np.inf
    gains = Gains.from_array(values[:3]).checked("calibration")
    return replace(estimate, gains=gains, delay_s=require_delay(float(values[3])), covariance=covariance)


class Problem:
    """The optimisation of one graph and its calibration, to be solved from several initial values.

    Attributes:
        others: the graph without the odometry edges from a node to the next, which `terms` stand for.
        terms: the terms of odometry, as of the last call of `solve`.
        key: number of the calibration among the GTSAM variables; those below are the nodes.
    """

    def __init__(self, graph: PoseGraph, motion: Motion, stamps_ns: NDArray[np.int64], config: BackendsConfig) -> None:
        self.graph, self.config = graph, config
        self.motion, self.stamps_ns = motion, stamps_ns
        self.others = graph.with_edges(np.setdiff1d(np.arange(graph.n_edges), own_odometry(graph)))
        self.key = graph.n_nodes
        self.terms = terms_of(graph, motion, stamps_ns, NEUTRAL)
        self._evaluated: tuple[bytes, Array, Array] | None = None

    def open_way(self) -> float:
        """Share of the travel where consecutive nodes are joined by odometry only."""
        only = self.terms.components == 3
        return float(np.sum(self.terms.legs.travel_m[only])) / max(float(self.motion.travel_m[-1]), 1e-9)

    def grown(self, start: Gains) -> Array:
        """Initial poses (N, 3): the graph grown node by node with incremental relaxation, on odometry calibrated by `start`."""
        graph = chain(corrected(self.graph, self.motion, self.stamps_ns, start))
        poses = graph.initial
        for solution in backends.replay(backends.create(RELAXATION, self.config), graph):
            poses = solution.poses
        return poses

    def solve(self, poses: Array, variable: Array, scale: float, bias_start_rad_m: float) -> Joint | None:
        """Solve from given poses and calibration, with `terms` made anew; None if GTSAM fails or the result is not finite.

        Args:
            poses: (N, 3) initial poses, m and rad.
            variable: (4,) initial gain, turn gain, heading bias (rad/m) and delay (s).
            scale: factor on the assumed standard deviations of odometry.
            bias_start_rad_m: initial heading bias of this attempt, for the log and the result.
        """
        gains = Gains.from_array(variable[:3])
        self.terms = terms_of(self.graph, self.motion, self.stamps_ns, gains).scaled(scale)
        self._evaluated = None
        nonlinear, begun = self._factors(), values(poses)
        begun.insert(self.key, variable)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(_ITERATIONS)
        params.setRelativeErrorTol(1e-6)
        try:
            solved = gtsam.LevenbergMarquardtOptimizer(nonlinear, begun, params).optimize()
            marginal = gtsam.Marginals(nonlinear, solved).marginalCovariance(self.key)
        except RuntimeError as error:
            _logger.info("from %.3f rad/m: %s", bias_start_rad_m, str(error).strip().splitlines()[:1])
            return None
        return self._result(solved, np.asarray(marginal), float(nonlinear.error(solved)), bias_start_rad_m)

    def scale(self, poses: Array, variable: Array) -> float:
        """Median ratio of the residuals of `terms` to their assumed size, at given poses (N, 3) and calibration (4,)."""
        norms = np.linalg.norm(self._residuals(poses, variable), axis=1)
        expected = np.array([_MEDIAN_OF_NORM[rows] for rows in self.terms.components])
        return max(float(np.median(norms / expected)), 1e-3)

    def require_held(self, poses: Array) -> None:
        """Refuse poses (N, 3) that contradict nearly all registrations and loops, as nothing then checks the calibration.

        Raises:
            NotToldError: fewer than three registrations and loops together have a weight of at least one half.
        """
        held = int(np.count_nonzero(squared_norms(self.others, poses) <= self.config.robust.cauchy_scale**2))
        if held < _HELD:
            raise NotToldError(
                f"calibration: found {held} of {self.others.n_edges} registrations and loop closures that agree with the map, "
                f"expected {_HELD} or more; give a drive that comes back to more places"
            )

    def _residuals(self, poses: Array, variable: Array) -> Array:
        predicted, _ = self.evaluate(variable)
        apart = between(poses[self.terms.sources], poses[self.terms.targets])
        return np.asarray(np.einsum("eij,ej->ei", self.terms.whiten, compose(inverse(predicted), apart)))

    def evaluate(self, variable: Array) -> tuple[Array, Array]:
        """Displacements (E, 3) of all odometry terms, m and rad, and their derivatives (E, 3, 4) by the calibration.

        A displacement is in the frame of its start. Its derivatives are right perturbations, in the frame of its end. Both are
        kept for the next call with the same calibration `variable` (4,).
        """
        mark = variable.tobytes()
        if self._evaluated is None or self._evaluated[0] != mark:
            gains, delay_s = Gains.from_array(variable[:3]), float(variable[3])
            self._evaluated = (mark, self.terms.legs.predict(gains, delay_s), self.terms.legs.jacobian(gains, delay_s))
        return self._evaluated[1], self._evaluated[2]

    def _result(self, solved: Any, marginal: Array, cost: float, bias_start_rad_m: float) -> Joint | None:
        variable = np.asarray(solved.atVector(self.key))
        solved.erase(self.key)
        poses = poses_of(solved)
        if not (np.isfinite(poses).all() and np.isfinite(variable).all()):
            return None
        squared = np.sum(self._residuals(poses, variable) ** 2, axis=1)
        weights = 1.0 / (1.0 + squared / CAUCHY**2)
        overlap = self.terms.overlap
        unit_variance = float((weights * squared).sum() / (weights * self.terms.components).sum()) * overlap
        estimate = Estimate(
            gains=Gains.from_array(variable[:3]),
            delay_s=float(variable[3]),
            covariance=marginal * unit_variance,
            leg_m=float(np.mean(self.terms.legs.travel_m)),
            legs=len(self.terms.legs) / overlap,
            travel_m=float(self.motion.travel_m[-1]),
            unit_variance=unit_variance,
            downweighted=float(np.mean(weights < 0.5)),
        )
        return Joint(poses, estimate, cost, bias_start_rad_m)

    def _factors(self) -> Any:
        loops = gtsam.noiseModel.mEstimator.Cauchy.Create(self.config.robust.cauchy_scale)
        kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY)
        unit = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Unit.Create(3))
        ends = zip(self.terms.sources.tolist(), self.terms.targets.tolist(), strict=True)
        legs = [gtsam.CustomFactor(unit, [*pair, self.key], leg_error(self, self.terms, k)) for k, pair in enumerate(ends)]
        prior = gtsam.PriorFactorVector(self.key, _NEUTRAL, gtsam.noiseModel.Diagonal.Sigmas(PRIOR))
        return collected([*factors(self.others, NoiseModels(loops)), *legs, anchor(self.graph.initial[0]), prior])


def leg_error(problem: Problem, terms: OdometryTerms, index: int) -> Callable[[Any, Any, Any], Array]:
    """Make the error function of odometry term `index` for a GTSAM custom factor.

    The error (3,) has unit variance: `terms.whiten[index]` times the target's pose (x, y, yaw; m, rad) relative to its
    prediction by calibrated odometry, in the predicted frame. For a long leg only the distance along the chord and the
    heading count, and the second number is 0; so is the first one if the chord is short against the path.
    """
    source, target = int(terms.sources[index]), int(terms.targets[index])
    whiten, key = terms.whiten[index], problem.key

    def error(_this: Any, values: Any, jacobians: Any) -> Array:
        predicted, slope = problem.evaluate(values.atVector(key))
        apart = values.atPose2(source).between(values.atPose2(target))
        off = gtsam.Pose2(*predicted[index]).between(apart)
        if jacobians is not None:
            turn = whiten.copy()
            turn[:, :2] = whiten[:, :2] @ off.rotation().matrix()
            jacobians[0] = -turn @ apart.inverse().AdjointMap()
            jacobians[1] = turn
            jacobians[2] = -turn @ off.inverse().AdjointMap() @ slope[index]
        return np.asarray(whiten @ (off.x(), off.y(), off.theta()))

    return error
