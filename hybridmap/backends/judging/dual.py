"""Lower bounds of the isotropised objective of a planar graph: the dual certificate of SE-Sync.

Rosen et al., "SE-Sync" (2019), in complex numbers. With positions t_i and unit headings z_i, and noise made isotropic
(kappa = I_yaw, tau = 2 / tr(I_xy^-1)), the cost

    F(t, z) = sum of 2 kappa |z_j - z_i e^(i yaw_ij)|^2 + tau |t_j - t_i - z_i t_ij|^2 = x^H Q x

is quadratic in x = (t, z). Let lambda_i = Re(conj(z_i) (Q x)_i); at a critical point F = sum lambda_i. For every choice of unit
headings F' >= sum lambda_i + n mu, mu the smallest eigenvalue of Q - diag(0, lambda) with the positions eliminated: if that
is not negative at a critical point, it is the best there is. A Cholesky-like factorisation of the matrix plus delta with
all pivots positive proves mu > -delta, and hence a relative gap of at most (F - sum lambda_i + n delta) / F.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, coo_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_Complex = NDArray[np.complex128]

_SLACKS = (1e-12, 1e-11, 1e-10, 1e-8, 1e-7, 1e-4, 1e-1)  # tried from the smallest: rounding makes zero eigenvalues negative
_ITERATIONS = 10
_STATIONARY = 1e-12  # relative decrease of F, promised by a Newton step, that no longer counts


@dataclass(frozen=True, slots=True)
class Proof:
    """What was proved about the critical point near given poses of F, which is chi2 with the noise made isotropic.

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
    form = quadratic_form(graph)
    given = np.concatenate([poses[:, 0] + 1j * poses[:, 1], np.exp(1j * poses[:, 2])])
    before = _objective(form, given)
    x = _polished(form, given)
    if x is None:
        return Proof(before, before, np.inf, reached=False)
    after = _objective(form, x)
    return Proof(after, before, _proved_gap(form, x, after), reached=True)


def quadratic_form(graph: PoseGraph) -> csr_array:
    """The Hermitian matrix Q (2N, 2N) of the objective x^H Q x; x holds positions, then headings, as complex numbers."""
    n, e = graph.n_nodes, graph.n_edges
    kappa = np.sqrt(2.0 * graph.information[:, 2, 2])
    tau = np.sqrt(2.0 / np.trace(np.linalg.inv(graph.information[:, :2, :2]), axis1=1, axis2=2))
    step, turn = graph.deltas[:, 0] + 1j * graph.deltas[:, 1], np.exp(1j * graph.deltas[:, 2])
    s, t, row = graph.sources, graph.targets, np.arange(e)
    entries = np.concatenate([kappa, -kappa * turn, tau, -tau, -tau * step])
    columns = np.concatenate([n + t, n + s, t, s, n + s])
    rows = np.concatenate([row, row, e + row, e + row, e + row])
    root = coo_array((entries, (rows, columns)), shape=(2 * e, 2 * n)).tocsr()
    return csr_array(root.conj().T @ root)


def _objective(form: csr_array, x: _Complex) -> float:
    return float(np.sum(x.conj() * np.asarray(form @ x)).real)


def _multipliers(form: csr_array, x: _Complex) -> Array:
    """(2N,): zero for positions, lambda_i for headings."""
    n = len(x) // 2
    return np.concatenate([np.zeros(n), (x[n:].conj() * np.asarray(form @ x)[n:]).real])


def _polished(form: csr_array, x: _Complex) -> _Complex | None:
    """Damped Newton on positions and heading angles until F stops falling; None if that takes too many steps."""
    cost, damping = _objective(form, x), 0.0
    for _ in range(_ITERATIONS):
        step, promised = _newton_step(form, x, damping)
        moved = _moved(x, step)
        after = _objective(form, moved)
        if abs(promised) <= _STATIONARY * cost:
            return moved
        if after < cost:
            x, cost, damping = moved, after, 0.1 * damping
        else:
            damping = max(10.0 * damping, 1e-6)
    return None


def _moved(x: _Complex, step: Array) -> _Complex:
    """Positions and headings after a step (3N,): x, y, angle."""
    n = len(x) // 2
    return np.concatenate([x[:n] + step[:n] + 1j * step[n : 2 * n], x[n:] * np.exp(1j * step[2 * n :])])


def _newton_step(form: csr_array, x: _Complex, damping: float) -> tuple[Array, float]:
    """Newton step (3N,) with the diagonal of the Hessian raised by a factor, and the predicted decrease of F."""
    n = len(x) // 2
    slope = np.asarray(form @ x)
    gradient = np.concatenate([slope[:n].real, slope[:n].imag, (np.conj(1j * x[n:]) * slope[n:]).real])
    turned = diags_array(np.concatenate([np.ones(n), 1j * x[n:]]))
    bent: Any = csr_array(turned.conj().T @ (form - diags_array(_multipliers(form, x))) @ turned)
    real, imag = bent.real, bent.imag
    hessian = block_array(
        [
            [real[:n, :n], None, real[:n, n:]],
            [None, real[:n, :n], imag[:n, n:]],
            [real[n:, :n], -imag[n:, :n], real[n:, n:]],
        ],
        format="csr",
    )
    free = np.arange(3 * n).reshape(3, n)[:, 1:].T.ravel()  # by node: x, y, angle
    matrix: Any = hessian[free][:, free].tocsc()
    factor = _factor(matrix + damping * diags_array(np.abs(matrix.diagonal())))
    step = np.zeros(3 * n)
    if factor is None:
        return step, np.inf
    step[free] = factor.solve(-gradient[free])
    promised = -float(gradient @ step)
    return (step, promised) if np.isfinite(promised) else (np.zeros(3 * n), np.inf)


def _proved_gap(form: csr_array, x: _Complex, cost: float) -> float:
    """(F - bound) / F for the best bound that the pivots prove; infinite if they prove none."""
    n = len(x) // 2
    multipliers = _multipliers(form, x)
    dual: Any = form - diags_array(multipliers)
    heading = np.concatenate([np.zeros(n), np.ones(n)])
    free = np.concatenate([[n], np.arange(1, n).repeat(2) + np.tile([0, n], n - 1)])  # without the position of node 0
    scale = max(cost, np.finfo(float).tiny)
    short = max(cost - float(multipliers.sum()), 0.0) / scale
    for slack in _SLACKS:
        shifted = dual + diags_array(slack * scale / n * heading)
        factor = _factor(shifted[free][:, free])
        if factor is not None and _positive(factor):
            return short + slack
    return np.inf


def _factor(matrix: Any) -> Any:
    """LU without row exchanges, as a Cholesky factorisation; None if it breaks down."""
    try:
        return splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:
        return None


def _positive(factor: Any) -> bool:
    """Whether a Hermitian matrix is positive definite, by the pivots of its factorisation."""
    pivots = factor.U.diagonal()
    return bool(np.array_equal(factor.perm_r, factor.perm_c) and np.all(pivots.real > 0.0))
