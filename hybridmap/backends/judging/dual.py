"""Lower bounds of quadratic objectives of a planar graph over all headings: the dual certificate of SE-Sync.

Rosen et al., "SE-Sync" (2019), in complex numbers. With positions t_i and unit headings z_i, an objective that is quadratic in
x = (t, z) is x^H Q x + constant. Let lambda_i = Re(conj(z_i) (Q x)_i); at a critical point x^H Q x = sum lambda_i. For every
choice of positions and unit headings x^H Q x >= sum lambda_i - n delta, if Q - diag(0, lambda) + delta diag(0, I) has no
negative eigenvalue. A factorisation with positive pivots proves that, after a bound of all its rounding is taken off.

Such an objective is F, chi2 with the noise made isotropic (kappa = I_yaw, tau = 2 / tr(I_xy^-1)), in SE-Sync's weights:

    F(t, z) = sum of 2 kappa |z_j - z_i e^(i yaw_ij)|^2 + tau |t_j - t_i - z_i t_ij|^2

It counts each heading twice: for small errors a |z_j - ...|^2 is the squared error. `judging.minorant` has one below chi2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

Complex = NDArray[np.complex128]

ROUNDOFF = 0.5 * float(np.finfo(float).eps)  # largest relative error of an addition
_OPERATIONS = 12  # additions' worth of rounding that a complex product and quotient may have, with room
_SLACK, _WORTHLESS = 1e-12, 1.0  # n delta over the objective: first and last value; rounding makes zero eigenvalues negative
_SMALL, _COARSE, _FINE = 1e-4, 10.0, 3.0  # it grows coarsely while it is small, then finely
_ROOM = 1.1  # for bounds of rounding that change a little from one factorisation to the next
_ATTEMPTS, _ITERATIONS = 30, 10
_STATIONARY = 1e-10  # relative decrease, promised by a Newton step, after which the next would promise next to nothing


@dataclass(frozen=True, slots=True)
class Form:
    """The objective x^H Q x + constant; x (2N,) holds positions (m), then unit headings, as complex numbers.

    Attributes:
        matrix: the Hermitian matrix Q (2N, 2N).
        constant: the constant.
        rounding: (2N,) bound of what rounding changed in each row of the matrix, as sum of absolute values.
    """

    matrix: csr_array
    constant: float
    rounding: Array

    def __call__(self, x: Complex) -> float:
        """The objective at x (2N,)."""
        return float(np.sum(x.conj() * np.asarray(self.matrix @ x)).real) + self.constant


@dataclass(frozen=True, slots=True)
class Proof:
    """What was proved about the critical point of F near given poses.

    Attributes:
        objective: F at the critical point; F at the given poses if it was not reached.
        objective_given: F at the given poses.
        gap: upper bound of (F - F_best) / F at the critical point, F_best being the global optimum; infinite if nothing was
            proved.
        reached: whether Newton steps led to a critical point.
    """

    objective: float
    objective_given: float
    gap: float
    reached: bool


def prove(graph: PoseGraph, poses: Array) -> Proof:
    """Find the critical point near given poses of F, which is chi2 with isotropic noise; bound its gap to the global optimum.

    Args:
        graph: a connected graph of two nodes or more.
        poses: (N, 3) finite poses, m and rad.
    """
    form, given = isotropised(graph), stacked(poses)
    before = form(given)
    x, reached = critical_point(form, given)
    if not reached:
        return Proof(before, before, np.inf, reached=False)
    after = form(x)
    gap = (after - lower_bound(form, x)) / max(after, np.finfo(float).tiny)
    return Proof(after, before, max(gap, 0.0), reached=True)


def stacked(poses: Array) -> Complex:
    """Positions from their mean, then unit headings (2N,), as complex numbers, of poses (N, 3)."""
    positions = poses[:, 0] + 1j * poses[:, 1]
    return np.concatenate([positions - positions.mean(), np.exp(1j * poses[:, 2])])


def isotropised(graph: PoseGraph) -> Form:
    """The objective F."""
    tau = 2.0 / np.trace(np.linalg.inv(graph.information[:, :2, :2]), axis1=1, axis2=2)
    double = 2.0 * graph.information[:, 2, 2]
    blocks = np.zeros((graph.n_edges, 3, 3), dtype=complex)
    blocks[:, 0, 0], blocks[:, 1, 1], blocks[:, 2, 2] = tau, double, double
    blocks[:, 1, 2] = blocks[:, 2, 1] = -double
    return form_of(graph, blocks, 0.0)


def edge_variables(graph: PoseGraph) -> csr_array:
    """The matrix (3E, 2N) from x to D, then a, then b of every edge.

    D = t_j - t_i - z_i t_ij (m) is the error of the position, a = z_i e^(i yaw_ij) the predicted heading, b = z_j the heading.
    """
    n, e = graph.n_nodes, graph.n_edges
    step, turn = graph.deltas[:, 0] + 1j * graph.deltas[:, 1], np.exp(1j * graph.deltas[:, 2])
    s, t, row, one = graph.sources, graph.targets, np.arange(e), np.ones(e)
    entries = np.concatenate([one, -one, -step, turn, one])
    columns = np.concatenate([t, s, n + s, n + s, n + t])
    rows = np.concatenate([row, row, row, e + row, 2 * e + row])
    return coo_array((entries, (rows, columns)), shape=(3 * e, 2 * n)).tocsr()


def form_of(graph: PoseGraph, blocks: Complex, constant: float) -> Form:
    """The sum over the edges of v^H block v + constant, with Hermitian blocks (E, 3, 3) and v = (D, a, b)."""
    side = edge_variables(graph)
    product: Any = side.conj().T @ _diagonal(blocks) @ side
    swapped = blocks[:, [0, 2, 1]][:, :, [0, 2, 1]]  # what cancelled in an entry with a adds up in the one with b
    sizes, steps = _diagonal(np.maximum(np.abs(blocks), np.abs(swapped))), abs(side)
    rows = np.asarray(steps.T @ (sizes @ (steps @ np.ones(2 * graph.n_nodes))))
    sums = np.diff(side.tocsc().indptr)  # edges at each node: terms of an entry
    return Form(csr_array(0.5 * (product + product.conj().T)), constant, ROUNDOFF * (sums + _OPERATIONS) * rows)


def _diagonal(blocks: NDArray[Any]) -> csr_array:
    """The matrix (3E, 3E) of blocks (E, 3, 3), for D, then a, then b of every edge."""
    e = len(blocks)
    place = np.arange(e)[:, None] + e * np.arange(3)
    rows, columns = (np.broadcast_to(one, blocks.shape).ravel() for one in (place[:, :, None], place[:, None, :]))
    return coo_array((blocks.ravel(), (rows, columns)), shape=(3 * e, 3 * e)).tocsr()


def critical_point(form: Form, x: Complex) -> tuple[Complex, bool]:
    """Damped Newton on positions and heading angles until the objective stops falling: best x (2N,), whether it is critical."""
    cost, damping = form(x), 0.0
    for _ in range(_ITERATIONS):
        step, promised = _newton_step(form.matrix, x, damping)
        moved = _moved(x, step)
        after = form(moved)
        if abs(promised) <= _STATIONARY * abs(cost):
            return moved, True
        if after < cost:
            x, cost, damping = moved, after, 0.1 * damping
        else:
            damping = max(10.0 * damping, 1e-6)
    return x, False


def lower_bound(form: Form, x: Complex) -> float:
    """A proved lower bound of the objective over all positions and unit headings; -inf if none was found.

    It is the better, the nearer x (2N,) is to a critical point; there it is the objective itself where the relaxation is exact.
    """
    n = len(x) // 2
    multipliers = _multipliers(form.matrix, x)
    dual: Any = form.matrix - diags_array(multipliers)
    heading = np.concatenate([np.zeros(n), np.ones(n)])
    held = int(np.argmin(np.abs(x[:n])))  # the objective does not change with a shift of all positions
    free = np.delete(np.arange(2 * n).reshape(2, n).T.ravel(), 2 * held)  # by node: position, heading
    terms = np.append(multipliers, form.constant)
    summed, scale = float(terms.sum() - 2 * n * ROUNDOFF * np.abs(terms).sum()), max(abs(form(x)), np.finfo(float).tiny)
    slack, margin = _SLACK, np.zeros(2 * n)  # of positions, which are not bounded, the rounding is taken off the matrix
    for _ in range(_ATTEMPTS):
        if not slack <= _WORTHLESS:
            break
        shifted = dual + diags_array(slack * scale / n * heading - margin)
        rounding = _rounding_of_positive(shifted[free][:, free])
        if rounding is None:
            slack *= _COARSE if slack < _SMALL else _FINE
            continue
        lost = np.zeros(2 * n)
        lost[free] = rounding + form.rounding[free] + 4.0 * ROUNDOFF * np.abs(shifted.diagonal()[free])
        if np.all(lost[:n] <= margin[:n]):
            return summed - slack * scale - float(lost[n:].sum())
        margin[:n] = _ROOM * lost[:n]
        slack = max(slack, _ROOM * float(np.sum(margin[:n] * np.abs(x[:n] - x[held]) ** 2)) / scale)
    return -np.inf


def _multipliers(matrix: csr_array, x: Complex) -> Array:
    """(2N,): zero for positions, lambda_i for headings."""
    n = len(x) // 2
    return np.concatenate([np.zeros(n), (x[n:].conj() * np.asarray(matrix @ x)[n:]).real])


def _moved(x: Complex, step: Array) -> Complex:
    """Positions and headings after a step (3N - 3,), by node without the first: x, y, angle."""
    n = len(x) // 2
    dx, dy, angle = np.concatenate([np.zeros(3), step]).reshape(n, 3).T
    return np.concatenate([x[:n] + dx + 1j * dy, x[n:] * np.exp(1j * angle)])


def _tangent(x: Complex) -> csr_array:
    """The matrix (2N, 3N - 3) from a small step, as `_moved` takes it, to the change of x (2N,)."""
    n = len(x) // 2
    node, entries = np.arange(1, n), np.concatenate([np.ones(n - 1), np.full(n - 1, 1j), 1j * x[n + 1 :]])
    columns = np.concatenate([3 * node - 3, 3 * node - 2, 3 * node - 1])
    return coo_array((entries, (np.concatenate([node, node, n + node]), columns)), shape=(2 * n, 3 * n - 3)).tocsr()


def _newton_step(matrix: csr_array, x: Complex, damping: float) -> tuple[Array, float]:
    """Newton step (3N - 3,) with the diagonal of the Hessian raised by a factor; the predicted decrease of the objective."""
    tangent = _tangent(x)
    turned: Any = tangent.conj().T
    gradient = np.asarray(turned @ (matrix @ x)).real
    hessian: Any = (turned @ (matrix - diags_array(_multipliers(matrix, x))) @ tangent).real
    factor = _factor(hessian + damping * diags_array(np.abs(hessian.diagonal())))
    if factor is None:
        return np.zeros(len(gradient)), np.inf
    step = factor.solve(-gradient)
    promised = -float(gradient @ step)
    return (step, promised) if np.isfinite(promised) else (np.zeros(len(gradient)), np.inf)


def _factor(matrix: Any) -> Any:
    """LU without row exchanges, as a Cholesky factorisation; None if it breaks down."""
    try:
        return splu(
            csc_array(matrix),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            relax=1,  # columns of planar graphs are short: work column by column is quicker than by panels
            panel_size=1,
            options={"SymmetricMode": True},
        )
    except RuntimeError:
        return None


def _rounding_of_positive(matrix: Any) -> Array | None:
    """Diagonal (K,) that, added to a Hermitian matrix (K, K), makes it positive semidefinite; None if a pivot is not positive.

    With pivots D > 0 the factors give L D L^H, which is positive, and what they miss of the matrix is bounded row by row: the
    rounding of the elimination, at most gamma |L| |U| (Higham, "Accuracy and Stability", theorem 9.3), and U - D L^H.
    """
    factor = _factor(matrix)
    if factor is None or not np.array_equal(factor.perm_r, factor.perm_c):
        return None
    lower, upper = factor.L.tocsr(), factor.U.tocsr()
    pivots = upper.diagonal().real
    if not np.all(pivots > 0.0):
        return None
    one = np.ones(len(pivots))
    low, up, skew = abs(lower), abs(upper), abs(diags_array(1.0 / pivots) @ upper - lower.conj().T)
    by_row, by_column = (np.diff(by.indptr) + _OPERATIONS for by in (lower, factor.U.tocsc()))  # terms of an entry
    eliminated = by_row * (low @ (up @ one)) + by_column * (up.T @ (low.T @ one))
    skewed = low @ (pivots * (skew @ one)) + skew.T @ (pivots * (low.T @ one))
    rows = 0.5 * (ROUNDOFF * eliminated + skewed)
    return np.asarray(rows[factor.perm_r], dtype=np.float64)
