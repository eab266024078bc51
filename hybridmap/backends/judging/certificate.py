"""Proof that a solution is at an optimum, and that the optimum is global for the objective with isotropic noise.

Over the inlier edges, three conditions are checked: (1) Levenberg-Marquardt on the true objective chi2 gains next to nothing
from the solution. (2) The critical point of the isotropised objective F near the solution is proved to be the global optimum
of F (`judging.dual`). (3) F at the solution is close to F at that point. A lower bound of chi2 itself is not proved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.backends.base import SolveStatus
from hybridmap.backends.gtsam.batch import run
from hybridmap.backends.gtsam.factors import NoiseModels, factor_graph
from hybridmap.backends.judging.dual import prove
from hybridmap.backends.objective import chi2
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

CERTIFIED_GAP = 1e-6
"""Relative gap up to which a solution is called certified."""

_AT_OPTIMUM = 1.01  # chi2 over that of the local optimum
_NEAR = 2.0  # F over its optimum: directions that are made isotropic move the optimum of a surveyed graph by up to 1.7
_EXACT = 1e-9  # chi2 that is rounding
_ITERATIONS, _TOLERANCE = 100, 1e-9


@dataclass(frozen=True, slots=True)
class Certificate:
    """What was proved about a solution; F is chi2 with the noise of every edge made isotropic.

    Attributes:
        gap: upper bound of (F - F_best) / F at the optimum of F near the solution, F_best being the global optimum; infinite if
            no bound was proved or the solution is not at an optimum.
        message: one line for people.
        objective: F at its optimum near the solution; NaN if that was not reached or not searched for.
        objective_given: F at the solution; NaN if not computed.
    """

    gap: float
    message: str
    objective: float = np.nan
    objective_given: float = np.nan

    @property
    def certified(self) -> bool:
        """Whether the solution is at a local optimum of chi2 close to the global optimum with isotropic noise."""
        return self.gap <= CERTIFIED_GAP

    @property
    def word(self) -> str:
        """`gap <= 1e-11`, or `not certified`."""
        return f"gap <= {self.gap:.0e}" if self.certified else "not certified"


def certify(graph: PoseGraph, poses: Array, rejected: tuple[int, ...] = ()) -> Certificate:
    """Check a solution against the nearby optimum of chi2, and against the global optimum with isotropic noise.

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
        return Certificate(0.0, "chi2 is zero up to rounding: every measurement is met, and no map has less")
    doubt = _not_at_optimum(kept, poses, cost, " over the edges kept" if rejected else "")
    return _refused(doubt) if doubt else _proved(kept, poses)


def _refused(why: str) -> Certificate:
    return Certificate(np.inf, f"not certified: {why}")


def _not_at_optimum(graph: PoseGraph, poses: Array, cost: float, counted: str) -> str:
    """Why poses with chi2 `cost` are not at an optimum of chi2; empty if they are."""
    local = run("lm", factor_graph(graph, NoiseModels()), poses, _ITERATIONS, tolerance=_TOLERANCE)
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
