"""Levenberg-Marquardt with a robust kernel on the loop edges; other edges stay quadratic unless configured otherwise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hybridmap.backends.following import Change, GraphBackend, Outcome
from hybridmap.backends.gtsam.batch import WarmStart, run
from hybridmap.backends.gtsam.factors import factor_graph
from hybridmap.backends.gtsam.initial import trusted_start
from hybridmap.backends.gtsam.kernels import loop_kernel, noise_models
from hybridmap.backends.objective import gate_of, squared_norms
from hybridmap.config.backends import BackendsConfig
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph


def judged(outcome: Outcome, kernel: Any, graph: PoseGraph, gate: float) -> Outcome:
    """The outcome with each loop's weight, and with the loops whose squared residual is beyond the gate rejected."""
    loops = graph.is_loop
    ids, squared = graph.edge_ids[loops], squared_norms(graph, outcome.poses)[loops]
    weights = {int(edge): float(kernel.weight(distance)) for edge, distance in zip(ids, np.sqrt(squared), strict=True)}
    return replace(outcome, weights=weights, rejected=tuple(ids[squared > gate].tolist()))


def with_kernel(name: str, graph: PoseGraph, start: Array, config: BackendsConfig) -> Outcome:
    """Levenberg-Marquardt with a back-end's kernel on loops, from given poses (N, 3)."""
    kernel = loop_kernel(name, config.robust)
    outcome = run("lm", factor_graph(graph, noise_models(config.robust, kernel)), start, config.max_iterations)
    return judged(outcome, kernel, graph, gate_of(config))


class WarmKernel:
    """A kernel's optimiser that carries on from update to update."""

    def __init__(self, name: str, config: BackendsConfig) -> None:
        self._config = config
        self._kernel = loop_kernel(name, config.robust)
        self._warm = WarmStart(noise_models(config.robust, self._kernel))

    def __call__(self, graph: PoseGraph, start: Array) -> Outcome:
        """See `WarmStart`; with weights and verdicts."""
        outcome = self._warm("lm", graph, start, self._config.max_iterations)
        return judged(outcome, self._kernel, graph, gate_of(self._config))


class KernelBackend(GraphBackend):
    """`gtsam-cauchy`, `gtsam-huber`, `gtsam-dcs`, `gtsam-geman-mcclure`."""

    _softens = True

    def __init__(self, name: str, config: BackendsConfig) -> None:
        super().__init__(name, config)
        self._warm = WarmKernel(name, config)

    def _follow(self, graph: PoseGraph, start: Array, change: Change) -> Outcome:
        del change
        return self._warm(graph, start)

    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        return with_kernel(self._name, graph, start, self._config)

    def _solve_whole(self, graph: PoseGraph) -> Outcome:
        start = trusted_start(graph, gate_of(self._config))
        outcome = self._optimise(graph, start)
        return outcome if start is graph.initial else replace(outcome, message=f"{outcome.message} (start: consecutive edges)")
