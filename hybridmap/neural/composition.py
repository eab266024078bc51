"""The contract of path integration, and plain composition of the odometry: what is left where there are no cells."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridmap.config.mapping import NeuralConfig
from hybridmap.errors import StreamError
from hybridmap.geometry import Array, compose, wrap_angle
from hybridmap.odometry_model import Gains, apply

LARGEST_STEP_M = 1000.0
"""No robot drives farther in one step, m."""

Snapshot = dict[str, NDArray[Any]]
"""State of a path integrator by name, as `snapshot` gives it."""


class Integrator(Protocol):
    """From self-motion to a pose; `neural.path_integrator.PathIntegrator` does it by cells.

    Attributes:
        config: settings of the cells.
        gains: calibration of the next steps; may be changed at any time.
    """

    config: NeuralConfig
    gains: Gains

    def step(self, delta_robot: ArrayLike, dt_s: float) -> None:
        """Integrate one displacement (3,), m and rad, seen from the robot before it, that took `dt_s` seconds."""

    @property
    def pose(self) -> Array:
        """Pose (3,), m and rad, in the frame in which the integrator started."""

    @property
    def place_code(self) -> NDArray[np.float32]:
        """Rates (P,) of the place cells; (0,) where there are none."""

    def snapshot(self) -> Snapshot:
        """The state that a node stores, so that `restore` returns to it."""

    def restore(self, snapshot: Snapshot, weight: float = 1.0, delta_snapshot_robot: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Go back to a stored state, or the share `weight` (0..1) of the way, moved by a relative pose (3,), m and rad."""


class Composition:
    """Composes the odometry as numbers, without any cell (`neural.modules: 0`): what the cells are worth is seen against it.

    Closures re-anchor the number as they re-anchor the cells. There is no place code, and no neuron that is noisy.

    Attributes:
        config: settings of the cells; only the gains are used.
        gains: calibration of the next steps; may be changed at any time.
        pose: (3,) m and rad, in the frame in which it started.
    """

    def __init__(self, config: NeuralConfig) -> None:
        self.config = config
        self.gains = Gains.of(config)
        self.pose: Array = np.zeros(3)

    def step(self, delta_robot: ArrayLike, dt_s: float) -> None:
        """Add one displacement; see `Integrator.step`.

        Raises:
            StreamError: as by `checked_step`.
        """
        step = np.array([checked_step(delta_robot, dt_s)])
        self.pose = compose(self.pose, apply(step, self.gains)[0])

    @property
    def place_code(self) -> NDArray[np.float32]:
        """(0,): there are no place cells."""
        return np.zeros(0, dtype=np.float32)

    def snapshot(self) -> Snapshot:
        """The pose; see `Integrator.snapshot`."""
        return {"pose": self.pose.copy()}

    def restore(self, snapshot: Snapshot, weight: float = 1.0, delta_snapshot_robot: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Set the pose; see `Integrator.restore`."""
        way = compose(snapshot["pose"], np.asarray(delta_snapshot_robot, dtype=np.float64)) - self.pose
        moved = self.pose + weight * np.array([way[0], way[1], wrap_angle(way[2])])
        self.pose = np.array([moved[0], moved[1], wrap_angle(moved[2])])


def checked_step(delta_robot: ArrayLike, dt_s: float) -> tuple[float, float, float]:
    """Return a displacement (3,) as (dx, dy, dyaw), m and rad.

    Raises:
        StreamError: the displacement or its time is not finite, or it is more than a kilometre.
    """
    dx, dy, dyaw = np.asarray(delta_robot, dtype=np.float64).tolist()
    if not math.isfinite(dx + dy + dyaw + dt_s):
        found = f"({dx}, {dy}, {dyaw}) in {dt_s} s"
        raise StreamError(f"self-motion: expected a finite displacement (dx, dy, dyaw) and time, found {found}")
    if math.hypot(dx, dy) > LARGEST_STEP_M:
        raise StreamError(f"self-motion: expected at most {LARGEST_STEP_M:g} m in one step, found {math.hypot(dx, dy):g} m")
    return dx, dy, dyaw
