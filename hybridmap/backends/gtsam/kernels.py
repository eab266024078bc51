"""Robust kernels of GTSAM: on loops by the back-end's name, on edges of motion where the configuration asks for one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gtsam import noiseModel

from hybridmap.backends.gtsam.factors import NoiseModels, Wrap
from hybridmap.config.backends import RobustConfig

_LOOP: dict[str, Callable[[RobustConfig], Any]] = {
    "gtsam-cauchy": lambda c: noiseModel.mEstimator.Cauchy.Create(c.cauchy_scale),
    "gtsam-huber": lambda c: noiseModel.mEstimator.Huber.Create(c.huber_scale),
    "gtsam-dcs": lambda c: noiseModel.mEstimator.DCS.Create(c.dcs_phi),
    "gtsam-geman-mcclure": lambda c: noiseModel.mEstimator.GemanMcClure.Create(c.geman_mcclure_scale),
}

_MOTION: dict[str, Any] = {
    "cauchy": noiseModel.mEstimator.Cauchy,
    "huber": noiseModel.mEstimator.Huber,
    "geman-mcclure": noiseModel.mEstimator.GemanMcClure,
}


def loop_kernel(name: str, config: RobustConfig) -> Any:
    """The kernel that a back-end of this name puts on loops."""
    return _LOOP[name](config)


def noise_models(config: RobustConfig, loop: Any = None) -> NoiseModels:
    """Noise models with a kernel on loops (None: quadratic) and the configured one on edges of motion."""
    motion = None if config.odometry == "none" else _MOTION[config.odometry].Create(config.odometry_scale)
    return NoiseModels(_wrap(loop), _wrap(motion))


def _wrap(kernel: Any) -> Wrap | None:
    return None if kernel is None else lambda base: noiseModel.Robust.Create(kernel, base)
