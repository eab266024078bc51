"""Whether a solution is at an optimum, and whether that is the global one of the isotropised objective.

Three things are checked, over the edges that the back-end kept: Levenberg-Marquardt on the true objective chi2 finds next
to nothing to gain from the solution; the critical point of the isotropised objective F beside it is proved to be the global
optimum of F (`judging.dual`); and F at the solution is near that. No lower bound of chi2 itself is proved, but for zero.
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
    """What could be proved about a solution.

    Attributes:
        gap: upper bound of (F - F_best) / F at the optimum of F beside the solution; infinite where none could be proved
            and where the solution itself is not at an optimum.
        message: one line for people.
        objective: F at its optimum beside the solution; NaN where none was reached or looked for.
        objective_given: F at the solution; NaN where it was not looked at.
    """

    gap: float
    message: str
    objective: float = np.nan
    objective_given: float = np.nan

    @property
    def certified(self) -> bool:
        """Whether the solution is at a local optimum of chi2 that lies beside the global optimum of F."""
        return self.gap <= CERTIFIED_GAP

    @property
    def word(self) -> str:
        """`gap <= 1e-11`, or `not certified`."""
        return f"gap <= {self.gap:.0e}" if self.certified else "not certified"


def certify(graph: PoseGraph, poses: Array, rejected: tuple[int, ...] = ()) -> Certificate:
    """Check a solution against the optimum of chi2 beside it, and that against the global optimum of F.

    Args:
        graph: connected.
        poses: (N, 3) the solution, m and rad.
        rejected: `edge_ids` that do not count, such as the loops that a robust back-end holds for false.
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
    """What speaks against poses being at an optimum of chi2, of which they have `cost`; empty if nothing does."""
    local = run("lm", factor_graph(graph, NoiseModels()), poses, _ITERATIONS, tolerance=_TOLERANCE)
    best = chi2(graph, local.poses)
    if cost > _AT_OPTIMUM * best:
        few = cost < 10.0 * best or best <= _EXACT
        less = f"{100.0 * (1.0 - best / cost):.2g} % less" if few else f"{cost / best:.0f} times less"
        where = "the one near it" if local.status is SolveStatus.CONVERGED else "one nearer to it"
        return f"this solution is not at an optimum; {where} has chi2 {best:.4g}{counted}, {less}"
    return "" if local.status is SolveStatus.CONVERGED else f"whether it is at an optimum is not known ({local.message})"


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
