"""The table of back-ends by name, which others can extend."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hybridmap.backends.base import ODOMETRY, Backend
from hybridmap.backends.judging.prefilter import ConsistentBackend
from hybridmap.config.backends import BackendsConfig
from hybridmap.errors import BackendError
from hybridmap.plugins import Table, loaded

Factory = Callable[[BackendsConfig], Backend]
"""Makes a back-end, in a fresh state, from the settings of all back-ends."""

LEAST_SQUARES, ROBUST, RELAXATION = "gtsam-lm", "gtsam-gnc", "relaxation-ratslam"
"""Names of the back-ends that others stand on: plain least squares, the robust one, and relaxation."""

_NOT_SEQUENTIAL = {ODOMETRY, "gtsam-isam2", "gtsam-gnc", "gtsam-calibrated"}

_OWN_STARTS = {"gtsam-calibrated"}


def _ours(name: str, path: str, **given: Any) -> tuple[str, Factory]:
    """An entry of the table; its module is imported when the back-end is made."""

    def make(config: BackendsConfig) -> Backend:
        backend: Backend = loaded(f"hybridmap.backends.{path}")(name, config, **given)
        return backend

    return name, make


_OURS = dict(
    (
        _ours(ODOMETRY, "odometry:create"),
        _ours("relaxation-paper", "relaxation.linear:paper"),
        _ours("relaxation-normalised", "relaxation.linear:normalised"),
        _ours("relaxation-ratslam", "relaxation.ratslam:plain"),
        _ours("relaxation-weighted", "relaxation.weighted:weighted"),
        _ours("relaxation-robust", "relaxation.ratslam:robust"),
        _ours("relaxation-gtsam-lm", "relaxation.ratslam:then_least_squares"),
        _ours("gtsam-lm", "gtsam.batch:create", method="lm"),
        _ours("gtsam-gn", "gtsam.batch:create", method="gn"),
        _ours("gtsam-dogleg", "gtsam.batch:create", method="dogleg"),
        _ours("gtsam-isam2", "gtsam.incremental:create"),
        _ours("gtsam-huber", "gtsam.robust:create", kernel="huber"),
        _ours("gtsam-cauchy", "gtsam.robust:create", kernel="cauchy"),
        _ours("gtsam-dcs", "gtsam.robust:create", kernel="dcs"),
        _ours("gtsam-geman-mcclure", "gtsam.robust:create", kernel="geman-mcclure"),
        _ours("gtsam-gnc", "gtsam.gnc:create"),
        _ours("gtsam-calibrated", "gtsam.calibrated:create"),
    )
)
_TABLE: Table[Factory] = Table("back-end", _OURS, "hybridmap.backends", BackendError)


def names() -> tuple[str, ...]:
    """The names of all back-ends: ours, then registered ones and those of installed packages."""
    return _TABLE.names()


def register(name: str, factory: Factory) -> None:
    """Add a back-end, so that every command accepts its name. Installed packages use the entry points `hybridmap.backends`.

    Raises:
        BackendError: the name is taken.
    """
    _TABLE.register(name, factory)


def require_elsewhere(name: str) -> None:
    """Check that a process which runs no code of this program has the back-end; see `Table.require_elsewhere`."""
    _TABLE.require_elsewhere(name)


def create(backend: str | Backend, config: BackendsConfig | None = None) -> Backend:
    """Make a back-end by its name, in its initial state, with the pre-filter before it if configured.

    If an instance is given instead of a name, it is returned unchanged, with its own settings and without a pre-filter.

    Args:
        backend: a name of `names`, or an instance.
        config: settings of all back-ends; its list of names is not used. None: the defaults.

    Raises:
        BackendError: no such name; the message lists the known names.
    """
    if not isinstance(backend, str):
        return backend
    config = config or BackendsConfig()
    made = unfiltered(backend, config)
    return ConsistentBackend(made, config) if config.consistency.enabled and backend != ODOMETRY else made


def unfiltered(name: str, config: BackendsConfig) -> Backend:
    """Make a back-end by its name, in its initial state, without the pre-filter.

    Raises:
        BackendError: no such name; the message lists the known names.
    """
    made = _TABLE[name](config)
    if made.name != name:
        raise BackendError(f"back-end {name!r}: has the name {made.name!r}; expected the name under which it is registered")
    return made


def is_sequential(name: str) -> bool:
    """Whether the back-end of this name is one of ours that iterates on one objective from start to end, in steps or sweeps."""
    return name in _OURS and name not in _NOT_SEQUENTIAL


def takes_start(name: str) -> bool:
    """Whether the back-end of this name can solve a whole graph from given poses and no others (`Driver.solve_as_given`)."""
    return name not in _OWN_STARTS
