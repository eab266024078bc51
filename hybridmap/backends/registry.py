"""The table of back-ends: name -> implementation, imported when it is made."""

from __future__ import annotations

from importlib import import_module

from hybridmap.backends.base import Backend
from hybridmap.backends.judging.prefilter import ConsistentBackend
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError

# name -> (module, class); every class is made as Class(name, config).
_TABLE = {
    "odometry": ("odometry", "OdometryBackend"),
    "relaxation-paper": ("relaxation.linear", "PaperRelaxation"),
    "relaxation-normalised": ("relaxation.linear", "NormalisedRelaxation"),
    "relaxation-ratslam": ("relaxation.ratslam", "RatslamRelaxation"),
    "relaxation-robust": ("relaxation.ratslam", "RobustRelaxation"),
    "relaxation-gtsam-lm": ("relaxation.hybrid", "HybridRelaxation"),
    "gtsam-lm": ("gtsam.batch", "BatchBackend"),
    "gtsam-gn": ("gtsam.batch", "BatchBackend"),
    "gtsam-dogleg": ("gtsam.batch", "BatchBackend"),
    "gtsam-isam2": ("gtsam.incremental", "Isam2Backend"),
    "gtsam-huber": ("gtsam.robust", "KernelBackend"),
    "gtsam-cauchy": ("gtsam.robust", "KernelBackend"),
    "gtsam-dcs": ("gtsam.robust", "KernelBackend"),
    "gtsam-geman-mcclure": ("gtsam.robust", "KernelBackend"),
    "gtsam-gnc": ("gtsam.gnc", "GncBackend"),
    "gtsam-calibrated": ("gtsam.calibrated", "CalibratedBackend"),
}


def names() -> tuple[str, ...]:
    """Every name that `create` takes."""
    return tuple(_TABLE)


def create(name: str, config: BackendsConfig | None = None) -> Backend:
    """Make a back-end by its name, in a fresh state; with the pre-filter before it, where that is configured.

    Raises:
        BackendError: no such name; the message lists those there are.
    """
    if name not in _TABLE:
        raise BackendError(f"unknown back-end {name!r}; there are {', '.join(_TABLE)}")
    module, class_name = _TABLE[name]
    config = config or BackendsConfig()
    backend: Backend = getattr(import_module(f"hybridmap.backends.{module}"), class_name)(name, config)
    if config.consistency.enabled and name != "odometry":
        return ConsistentBackend(backend, config)
    return backend
