"""Levenberg-Marquardt with a robust kernel on the loop edges; other edges are quadratic unless configured otherwise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hybridmap.backends.base import Outcome
from hybridmap.backends.driver import Driver
from hybridmap.backends.gtsam.batch import WarmStart, run
from hybridmap.backends.gtsam.factors import factor_graph, loop_kernel, noise_models
from hybridmap.backends.gtsam.initial import trusted_start
from hybridmap.backends.objective import gate_of, squared_norms
from hybridmap.config.backends import BackendsConfig
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph


def create(name: str, config: BackendsConfig, kernel: str) -> Driver:
    """A back-end with the kernel `cauchy`, `huber`, `dcs` or `geman-mcclure`."""

    def given(graph: PoseGraph, start: Array) -> Outcome:
        return with_kernel(kernel, graph, start, config)

    def solve(graph: PoseGraph, initial: Array) -> Outcome:
        start = trusted_start(graph, initial, gate_of(config))
        outcome = given(graph, start)
        return outcome if start is initial else replace(outcome, message=f"{outcome.message} (start: consecutive edges)")

    warm = WarmKernel(kernel, config)
    return Driver(name, config, solve, follow=warm, given=given, softens=True, remembers=warm)


def judged(outcome: Outcome, kernel: Any, graph: PoseGraph, gate: float) -> Outcome:
    """Copy of the outcome with the weight of each loop; loops with a squared residual beyond the gate are rejected."""
    loops = graph.is_loop
    ids, squared = graph.edge_ids[loops], squared_norms(graph, outcome.poses)[loops]
    weights = {int(edge): float(kernel.weight(distance)) for edge, distance in zip(ids, np.sqrt(squared), strict=True)}
    return replace(outcome, weights=weights, rejected=tuple(ids[squared > gate].tolist()))


def with_kernel(name: str, graph: PoseGraph, start: Array, config: BackendsConfig) -> Outcome:
    """Run Levenberg-Marquardt with the kernel `name` on loops, from poses `start` (N, 3)."""
    kernel = loop_kernel(name, config.robust)
    outcome = run("lm", factor_graph(graph, noise_models(config.robust, kernel)), start, config.max_iterations)
    return judged(outcome, kernel, graph, gate_of(config))


class WarmKernel:
    """Levenberg-Marquardt with a kernel on loops, warm-started from update to update."""

    def __init__(self, name: str, config: BackendsConfig) -> None:
        self._kernel, self._gate = loop_kernel(name, config.robust), gate_of(config)
        self._warm = WarmStart("lm", noise_models(config.robust, self._kernel), config.max_iterations)

    def memory(self) -> Any:
        """See `WarmStart.memory`."""
        return self._warm.memory()

    def remember(self, memory: Any) -> None:
        """See `WarmStart.remember`."""
        self._warm.remember(memory)

    def __call__(self, graph: PoseGraph, start: Array) -> Outcome:
        """See `WarmStart`; the outcome also has weights and rejected loops."""
        return judged(self._warm(graph, start), self._kernel, graph, self._gate)
