"""A proved lower bound of chi2 itself: a quadratic objective that is nowhere above chi2 and touches it at a map.

Of an edge, let (d, theta) be the pose of the target relative to its prediction, d as a complex number (m). With
s = (theta/2) / sin(theta/2) >= 1, sigma = 2 sin(theta/2) and q = e^(-i theta/2) d the SE(2) logarithm is s (q, sigma). So
the squared residual is s^2 (q, sigma)^T I (q, sigma), and completing the square in I, with P its position block, g its
coupling, c = P^-1 g, beta its Schur complement, and p, p + k the eigenvalues of P, n the unit vector of the larger,

    chi2 of the edge  >=  p |q + c sigma|^2 + beta sigma^2 + k h^2,    h = n . (q + c sigma).

The first two terms are quadratic in positions and unit headings x = (t, z). With D, a, b of `dual.edge_variables`,
w = b - a: |q| = |D|, sigma = |w|, q sigma = i D conj(w). For the last, cos(theta/2) h = Re(conj(n) (a + b)^* D / 2) +
(n . c) Im(a^* b) is quadratic in x, |cos| <= 1, and h^2 >= 2 y h - y^2 for every number y: with y from a map nothing is lost
there. What remains lost is of the order of theta^2: 0.03 % of chi2 and less on surveyed graphs.

`judging.dual` bounds the sum over the edges from below. Any map gives a valid bound; one at the global optimum the best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridmap.backends.judging.dual import (
    ROUNDOFF,
    Complex,
    Form,
    critical_point,
    edge_variables,
    form_of,
    lower_bound,
    stacked,
)
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_ROUNDING = 32.0  # of the split of an information matrix, in roundoffs of its largest entries, with room


def chi2_bound(graph: PoseGraph, poses: Array) -> float:
    """A number that is proved to be at most the chi2 of every map of the graph; 0 if no better one was found.

    Time and memory grow as those of a sparse factorisation.

    Args:
        graph: a connected graph of two nodes or more.
        poses: (N, 3) finite poses, m and rad, best at an optimum of chi2: there the minorant touches chi2.
    """
    x, form = stacked(poses), minorant(graph, poses)
    return max(lower_bound(form, critical_point(form, x)[0]), 0.0)


@dataclass(frozen=True, slots=True)
class _Split:
    """Information (E, 3, 3) as p |q + c sigma|^2 + beta sigma^2 + k (n . (q + c sigma))^2; vectors as complex numbers."""

    loose: Array  # p, 1/m^2
    stiffer: Array  # k, 1/m^2
    direction: Complex  # n
    offset: Complex  # c, m
    heading: Array  # beta, 1/rad^2


def _split(information: Array) -> _Split:
    """The split, with `loose` and `heading` lowered by what rounding may have added to the rest."""
    symmetric = 0.5 * (information + information.transpose(0, 2, 1))
    values, vectors = np.linalg.eigh(symmetric[:, :2, :2])
    coupling = symmetric[:, :2, 2]
    offset = np.linalg.solve(symmetric[:, :2, :2], coupling[..., None])[..., 0]
    heading = symmetric[:, 2, 2] - np.sum(coupling * offset, axis=1)
    largest, reach = values[:, 1], np.sum(offset**2, axis=1)
    return _Split(
        loose=values[:, 0] - _ROUNDING * ROUNDOFF * largest,
        stiffer=values[:, 1] - values[:, 0],
        direction=vectors[:, 0, 1] + 1j * vectors[:, 1, 1],
        offset=offset[:, 0] + 1j * offset[:, 1],
        heading=heading - _ROUNDING * ROUNDOFF * (symmetric[:, 2, 2] + largest * reach),
    )


def minorant(graph: PoseGraph, poses: Array) -> Form:
    """A quadratic objective, at most chi2 at all poses, and at given ones (N, 3) equal to it but for terms of theta^2."""
    split = _split(graph.information)
    d, a, b = np.asarray(edge_variables(graph) @ stacked(poses)).reshape(3, graph.n_edges)
    n, c = split.direction, split.offset
    lever = (n.conj() * c).real
    y = (n.conj() * (a + b).conj() * d).real / 2.0 + lever * (a.conj() * b).imag
    pull = split.stiffer * y
    turning = split.loose * np.abs(c) ** 2 + split.heading
    blocks = np.zeros((graph.n_edges, 3, 3), dtype=complex)
    blocks[:, 0, 0], blocks[:, 1, 1], blocks[:, 2, 2] = split.loose, turning, turning
    coupled = 1j * split.loose * c.conj()
    blocks[:, 1, 0] = 0.5 * pull * n.conj() - coupled
    blocks[:, 2, 0] = 0.5 * pull * n.conj() + coupled
    blocks[:, 1, 2] = -turning - 1j * pull * lever
    blocks[:, 0, 1], blocks[:, 0, 2], blocks[:, 2, 1] = (blocks[:, [1, 2, 1], [0, 0, 2]].conj()).T
    return form_of(graph, blocks, -float(np.sum(pull * y)))
