"""What is proved about a solution: how far its chi2 is above that of the best map, and whether F is at its global optimum.

Both over the edges that the solution keeps. Of chi2, the referee's objective, a lower bound is proved that holds of every map
(`judging.minorant`). Of F, chi2 with the noise made isotropic, as SE-Sync has it, three conditions are checked:
(1) Levenberg-Marquardt on chi2 gains next to nothing from the solution. (2) The critical point of F near the solution is
proved to be the global optimum of F (`judging.dual`). (3) F at the solution is close to F at that point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybridmap.backends.base import Outcome, SolveStatus
from hybridmap.backends.gtsam.batch import run
from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph
from hybridmap.backends.gtsam.initial import angular_start
from hybridmap.backends.judging.dual import prove
from hybridmap.backends.judging.minorant import chi2_bound
from hybridmap.backends.objective import chi2
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph
from hybridmap.metrics import proved

CERTIFIED_GAP = 1e-6
"""Relative gap up to which a solution is called certified."""

_AT_OPTIMUM = 1.01  # chi2 over that of the local optimum
_NEAR = 2.0  # F over its optimum: directions that are made isotropic move the optimum of a surveyed graph by up to 1.7
_EXACT = 1e-9  # chi2 that is rounding
_LOOSE = 0.1  # share of chi2 that a bound from the global optimum is below it only where noise is large
_ITERATIONS, _TOLERANCE = 100, 1e-9


@dataclass(frozen=True, slots=True)
class Certificate:
    """What was proved about a solution over the edges that it keeps; F is chi2 with the noise of every edge made isotropic.

    Attributes:
        gap: upper bound of (F - F_best) / F at the optimum of F near the solution, F_best being the global optimum; infinite if
            no bound was proved or the solution is not at an optimum.
        message: one line for people, about F.
        objective: F at its optimum near the solution; NaN if that was not reached or not searched for.
        objective_given: F at the solution; NaN if not computed.
        chi2: chi2 of the solution; infinite if a pose is not finite.
        chi2_bound: a number that is proved to be at most the chi2 of every map; 0 if no better one was found.
    """

    gap: float
    message: str
    objective: float = np.nan
    objective_given: float = np.nan
    chi2: float = np.inf
    chi2_bound: float = 0.0

    @property
    def certified(self) -> bool:
        """Whether the solution is at a local optimum of chi2 close to the global optimum with isotropic noise."""
        return self.gap <= CERTIFIED_GAP

    @property
    def word(self) -> str:
        """`gap <= 1e-11`, or `not certified`."""
        return f"gap <= {proved(self.gap, 1):.0e}" if self.certified else "not certified"

    @property
    def chi2_gap(self) -> float:
        """Upper bound of (chi2 - chi2_best) / chi2 of the solution, chi2_best being the least of any map; 1: nothing proved."""
        if not np.isfinite(self.chi2):
            return 1.0
        return 0.0 if self.chi2 <= _EXACT else max(1.0 - self.chi2_bound / self.chi2, 0.0)

    @property
    def chi2_word(self) -> str:
        """The gap of chi2: `<= 2.4e-06`, `<= 44 %`, or `not proved`."""
        if self.chi2_gap >= 1.0:
            return "not proved"
        if self.chi2_gap < 0.01:
            return f"<= {proved(self.chi2_gap, 2):.2g}"
        return f"<= {proved(100.0 * self.chi2_gap, 3):.3g} %"

    @property
    def chi2_message(self) -> str:
        """One line for people, about chi2."""
        if self.chi2_gap >= 1.0:
            return "nothing is proved about the least chi2 of any map"
        if self.chi2 <= _EXACT:
            return "chi2 is zero up to rounding: every measurement is met, and no map has less"
        return (
            f"proved: no map has less than {proved(self.chi2_bound, 7, at_least=True):.7g} over the edges kept;"
            f" this one has {self.chi2:.7g}, gap {self.chi2_word}"
        )


def certify(graph: PoseGraph, poses: Array, rejected: tuple[int, ...] = ()) -> Certificate:
    """Bound chi2 of every map from below, and check a solution against the global optimum with isotropic noise.

    Args:
        graph: a connected graph.
        poses: (N, 3) poses of the solution, m and rad.
        rejected: edge ids to leave out, such as the outlier loops of a robust back-end.
    """
    kept = graph.with_edges(~np.isin(graph.edge_ids, rejected)) if rejected else graph
    cost = chi2(kept, poses)
    if not np.isfinite(cost):
        return _refused("the poses have no finite chi2")
    if cost <= _EXACT:
        return Certificate(0.0, "chi2 is zero up to rounding: every measurement is met, and no map has less", chi2=cost)
    local = _optimum(kept, poses)
    doubt = _not_at_optimum(kept, local, cost, " over the edges kept" if rejected else "")
    proof = _refused(doubt) if doubt else _proved(kept, poses)
    return replace(proof, chi2=cost, chi2_bound=_bounded(kept, local.poses))


def _optimum(graph: PoseGraph, poses: Array) -> Outcome:
    """The optimum of chi2 near poses."""
    return run("lm", factor_graph(graph, NoiseModels()), poses, _ITERATIONS, tolerance=_TOLERANCE)


def _bounded(graph: PoseGraph, poses: Array) -> float:
    """A lower bound of chi2 from an optimum at poses; if that is poor, the better of it and one from averaged rotations."""
    bound = chi2_bound(graph, poses)
    if bound >= (1.0 - _LOOSE) * chi2(graph, poses):
        return bound
    start = angular_start(graph)
    return bound if start is None else max(bound, chi2_bound(graph, _optimum(graph, start).poses))


def _refused(why: str) -> Certificate:
    return Certificate(np.inf, f"not certified: {why}")


def _not_at_optimum(graph: PoseGraph, local: Outcome, cost: float, counted: str) -> str:
    """Why poses with chi2 `cost` are not at an optimum of chi2, the one near them being `local`; empty if they are."""
    best = chi2(graph, local.poses)
    if cost > _AT_OPTIMUM * best:
        few = cost < 10.0 * best or best <= _EXACT
        less = f"{100.0 * (1.0 - best / cost):.2g} % less" if few else f"{cost / best:.0f} times less"
        where = "the one near it" if local.status is SolveStatus.CONVERGED else "one nearer to it"
        return f"this solution is not at an optimum; {where} has chi2 {best:.4g}{counted}, {less}"
    return (
        "" if local.status is SolveStatus.CONVERGED else f"whether the solution is at an optimum is not known ({local.message})"
    )


def _proved(graph: PoseGraph, poses: Array) -> Certificate:
    """The proof for poses that are at an optimum of chi2."""
    proof = prove(graph, poses)
    if not proof.reached:
        return _refused("no optimum of the isotropised objective near it")
    if proof.objective_given > _NEAR * proof.objective + _EXACT:
        return _refused(
            f"its isotropised objective is {proof.objective_given:.4g}, that of the optimum near it {proof.objective:.4g}"
        )
    bound = f"relative gap <= {proof.gap:.0e}" if np.isfinite(proof.gap) else "no bound could be proved"
    known = f"F = {proof.objective:.7g}, {bound}"
    message = known if proof.gap <= CERTIFIED_GAP else f"not certified: {known}"
    return Certificate(proof.gap, message, proof.objective, proof.objective_given)
