"""Initial poses for optimisers: headings by linear rotation averaging, then positions by linear least squares."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu

from hybridmap.backends.objective import chi2, truncated_cost
from hybridmap.geometry import Array
from hybridmap.graph.paths import extend
from hybridmap.graph.pose_graph import PoseGraph

_NEAR = 100.0  # mean squared Mahalanobis residual from which another start is looked for


def best_start(graph: PoseGraph, given: Array) -> Array:
    """Initial poses (N, 3): those of `angular_start` or the given ones (N, 3), whichever have the lower chi2.

    If the given poses fit the edges within some standard deviations, they are taken directly: a chain with a wrong winding
    would not fit.
    """
    own = chi2(graph, given)
    if own <= _NEAR * graph.n_edges:
        return given
    angular = angular_start(graph)
    return given if angular is None or own <= chi2(graph, angular) else angular


def trusted_start(graph: PoseGraph, given: Array, bound: float) -> Array:
    """Initial poses (N, 3) for back-ends that must not trust loops.

    They are the given ones (N, 3), or those composed along the best edges (`extend`), whichever have the lower chi2 with the
    squared residuals of loops truncated at `bound`. In a map `initial` is odometry alone, and registrations are more accurate.
    """
    chained = extend(graph, graph.initial[:1])
    return min((given, chained), key=lambda poses: truncated_cost(graph, poses, bound))


def angular_start(graph: PoseGraph) -> Array | None:
    """Poses (N, 3) by two sparse linear solves; None if they are singular.

    Headings: unit complex numbers z minimise sum of w |z_target - z_source exp(i dyaw)|^2 with z_0 fixed, then |z| = 1
    (the chordal relaxation of rotation averaging; valid for any winding). Positions: with these headings, the sum of
    squared translation residuals weighted by the edge's isotropised information.
    """
    if graph.n_nodes < 2:
        return graph.initial
    with np.errstate(all="ignore"):
        w_yaw = graph.information[:, 2, 2]
        turned = np.exp(1j * graph.deltas[:, 2])
        z = _solve(graph, w_yaw, turned, np.zeros(graph.n_edges, dtype=complex), np.exp(1j * graph.initial[0, 2]))
        if z is None or np.any(np.abs(z) < 1e-9):
            return None
        z = z / np.abs(z)
        w_xy = 0.5 * (graph.information[:, 0, 0] + graph.information[:, 1, 1])
        steps = z[graph.sources] * (graph.deltas[:, 0] + 1j * graph.deltas[:, 1])
        ones = np.ones(graph.n_edges, dtype=complex)
        p = _solve(graph, w_xy, ones, steps, complex(*graph.initial[0, :2]))
    return None if p is None else np.column_stack([p.real, p.imag, np.angle(z)])


def _solve(
    graph: PoseGraph, weight: Array, turned: NDArray[np.complex128], offset: NDArray[np.complex128], fixed: complex
) -> NDArray[np.complex128] | None:
    """Minimise sum of weight |u_target - turned u_source - offset|^2 with u_0 = fixed."""
    n, e = graph.n_nodes, graph.n_edges
    rows = np.arange(e)
    entries = np.concatenate([-turned, np.ones(e, dtype=complex)])
    ends = np.concatenate([graph.sources, graph.targets])
    a = coo_array((entries, (np.tile(rows, 2), ends)), shape=(e, n)).tocsc()
    free = a[:, 1:]
    right = offset - a[:, [0]].toarray()[:, 0] * fixed
    scaled = free.conj().T @ diags_array(weight / weight.max())
    normal: Any = (scaled @ free).tocsc()
    try:
        factor: Any = splu(normal, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    except RuntimeError:
        return None
    solved = factor.solve(scaled @ right)
    return np.concatenate([[fixed], solved]) if np.isfinite(solved).all() else None
