"""Levenberg-Marquardt with a robust kernel on the loop edges; every other edge stays quadratic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from hybridmap.backends.batch import run
from hybridmap.backends.factors import NoiseModels, factor_graph
from hybridmap.backends.following import GraphBackend, Outcome
from hybridmap.backends.objective import squared_norms
from hybridmap.config.backends import BackendsConfig, RobustConfig
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_KERNELS: dict[str, Callable[[RobustConfig], Any]] = {
    "gtsam-cauchy": lambda c: gtsam.noiseModel.mEstimator.Cauchy.Create(c.cauchy_scale),
    "gtsam-huber": lambda c: gtsam.noiseModel.mEstimator.Huber.Create(c.huber_scale),
    "gtsam-dcs": lambda c: gtsam.noiseModel.mEstimator.DCS.Create(c.dcs_phi),
}


def kernel_models(name: str, config: RobustConfig) -> tuple[Any, NoiseModels]:
    """The kernel of a back-end's name, and noise models that put it on loop edges."""
    kernel = _KERNELS[name](config)
    return kernel, NoiseModels(lambda base: gtsam.noiseModel.Robust.Create(kernel, base))


def loop_weights(kernel: Any, graph: PoseGraph, poses: Array) -> dict[int, float]:
    """Loop edge id -> the kernel's weight of its residual, in [0, 1]."""
    loops = graph.is_loop
    distance = np.sqrt(squared_norms(graph, poses)[loops])
    return {int(e): float(kernel.weight(d)) for e, d in zip(graph.edge_ids[loops], distance, strict=True)}


def cauchy(graph: PoseGraph, start: Array, config: BackendsConfig) -> Outcome:
    """Levenberg-Marquardt with Cauchy on loops, from given poses; weights in the outcome."""
    return _with_kernel("gtsam-cauchy", graph, start, config)


def _with_kernel(name: str, graph: PoseGraph, start: Array, config: BackendsConfig) -> Outcome:
    kernel, models = kernel_models(name, config.robust)
    outcome = run("lm", factor_graph(graph, models), start, config.max_iterations)
    weights = loop_weights(kernel, graph, outcome.poses)
    return Outcome(outcome.poses, outcome.status, outcome.message, outcome.iterations, weights)


class KernelBackend(GraphBackend):
    """`gtsam-cauchy`, `gtsam-huber`, `gtsam-dcs`."""

    def _optimise(self, graph: PoseGraph, start: Array) -> Outcome:
        return _with_kernel(self._name, graph, start, self._config)
