"""Conversion of graphs, robust kernels and poses to GTSAM and back."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import gtsam
import numpy as np

from hybridmap.backends.objective import ODOMETRY_SCALE
from hybridmap.config.backends import RobustConfig
from hybridmap.geometry import Array
from hybridmap.graph.pose_graph import PoseGraph

_PRIOR_SIGMA = 1e-3  # zero residual at the optimum: fixes the frame without touching chi2

HUBER_SCALE = 1.345
"""Whitened residual from which a Huber cost is linear: 95 % efficient where all noise is Gaussian (Holland and Welsch 1977)."""
DCS_PHI = 1.0
"""Dynamic covariance scaling: squared whitened residual from which a loop is scaled down (Agarwal et al. 2013)."""
GEMAN_MCCLURE_SCALE = 2.0
"""Whitened residual at which the Geman-McClure weight of a loop is a quarter; one of honest noise keeps a third."""

_LOOP: dict[str, Callable[[RobustConfig], Any]] = {
    "cauchy": lambda c: gtsam.noiseModel.mEstimator.Cauchy.Create(c.cauchy_scale),
    "huber": lambda _: gtsam.noiseModel.mEstimator.Huber.Create(HUBER_SCALE),
    "dcs": lambda _: gtsam.noiseModel.mEstimator.DCS.Create(DCS_PHI),
    "geman-mcclure": lambda _: gtsam.noiseModel.mEstimator.GemanMcClure.Create(GEMAN_MCCLURE_SCALE),
}

_MOTION: dict[str, Any] = {
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
}


class NoiseModels:
    """Noise models, shared between edges of equal information, with robust kernels on loops, odometry and registration."""

    def __init__(self, loop: Any = None, motion: Any = None) -> None:
        """Set a kernel for loops and one for odometry and registration edges (`PoseGraph.is_motion`); None: quadratic."""
        self._plain: dict[bytes, Any] = {}
        self._robust: dict[tuple[bytes, bool], Any] = {}
        self._loop, self._motion = loop, motion

    def __call__(self, information: Array, *, loop: bool = False, motion: bool = False) -> Any:
        """The noise model of one edge with this information (3, 3); `loop` and `motion` choose which kernel it gets, if any."""
        return self._model(information.tobytes(), information, loop=loop, motion=motion)

    def of(self, graph: PoseGraph) -> list[Any]:
        """The noise model of every edge of a graph, in its order."""
        information = np.ascontiguousarray(graph.information)
        keys = information.reshape(-1, 9).view("V72").ravel().tolist()  # the bytes of all matrices in one call
        rows = zip(keys, information, graph.is_loop.tolist(), graph.is_motion.tolist(), strict=True)
        return [self._model(key, info, loop=loop, motion=motion) for key, info, loop, motion in rows]

    def _model(self, key: bytes, information: Array, *, loop: bool, motion: bool) -> Any:
        model = self._plain.get(key)
        if model is None:
            model = self._plain[key] = gtsam.noiseModel.Gaussian.Information(information)
        kernel = self._loop if loop else self._motion if motion else None
        if kernel is None:
            return model
        robust = self._robust.get((key, loop))
        if robust is None:
            robust = self._robust[key, loop] = gtsam.noiseModel.Robust.Create(kernel, model)
        return robust


def loop_kernel(name: str, config: RobustConfig) -> Any:
    """The GTSAM kernel for loops of this name: `cauchy`, `huber`, `dcs` or `geman-mcclure`."""
    return _LOOP[name](config)


def noise_models(config: RobustConfig, loop: Any = None) -> NoiseModels:
    """Noise models with the kernel `loop` on loops (None: quadratic), and the configured one on other edges."""
    motion = None if config.odometry == "none" else _MOTION[config.odometry].Create(ODOMETRY_SCALE)
    return NoiseModels(loop, motion)


def factors(graph: PoseGraph, models: NoiseModels) -> list[Any]:
    """A between factor for every edge, in the graph's order."""
    make, pose = gtsam.BetweenFactorPose2, gtsam.Pose2
    rows = zip(graph.sources.tolist(), graph.targets.tolist(), graph.deltas.tolist(), models.of(graph), strict=True)
    return [make(s, t, pose(*delta), model) for s, t, delta, model in rows]


def anchor(initial: Array) -> Any:
    """The prior factor that holds node 0 at the pose `initial` (3,)."""
    noise = gtsam.noiseModel.Isotropic.Sigma(3, _PRIOR_SIGMA)
    return gtsam.PriorFactorPose2(0, gtsam.Pose2(*initial), noise)


def factor_graph(graph: PoseGraph, models: NoiseModels) -> Any:
    """All edges, and the prior that holds node 0 at its initial pose, as a `NonlinearFactorGraph`."""
    return collected([*factors(graph, models), anchor(graph.initial[0])])


def collected(parts: Iterable[Any]) -> Any:
    """Make a `NonlinearFactorGraph` of single factors."""
    out = gtsam.NonlinearFactorGraph()
    for part in parts:
        out.add(part)  # of the two names for it the one without overloads, a fifth of the cost
    return out


def values(poses: Array, first: int = 0) -> Any:
    """Poses `(N, 3)` as `gtsam.Values`, with keys from `first` on."""
    out = gtsam.Values()
    for key, pose in enumerate(poses.tolist(), start=first):
        out.insert(key, gtsam.Pose2(*pose))
    return out


def poses_of(result: Any) -> Array:
    """`gtsam.Values` with keys 0..N-1 as `(N, 3)`."""
    return np.array(gtsam.utilities.extractPose2(result), dtype=np.float64).reshape(-1, 3)


def exact_poses(result: Any, n_nodes: int) -> Array:
    """`gtsam.Values` with keys 0..N-1 as (N, 4): x, y, cosine and sine of the yaw, without rounding."""
    poses = [result.atPose2(key) for key in range(n_nodes)]
    rows = [(pose.x(), pose.y(), pose.rotation().c(), pose.rotation().s()) for pose in poses]
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def exact_values(exact: Array) -> Any:
    """The `gtsam.Values` that `exact_poses` read, to the bit; of a yaw alone the cosine would differ in its last bit."""
    out = gtsam.Values()
    for key, (x, y, cos, sin) in enumerate(exact.tolist()):
        out.insert(key, gtsam.Pose2(gtsam.Rot2.fromCosSin(cos, sin), np.array([x, y])))
    return out
