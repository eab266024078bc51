"""Drives for the tests: the motion at each step, and the exact path."""

from __future__ import annotations

import numpy as np

from hybridmap import geometry


def arc(v_m_s: float, omega_rad_s: float, dt_s: float) -> np.ndarray:
    """Return the motion (3,) of one step in the frame before it, with the mid-point heading."""
    ds, dyaw = v_m_s * dt_s, omega_rad_s * dt_s
    return np.array([ds * np.cos(dyaw / 2), ds * np.sin(dyaw / 2), dyaw])


def wander(seed: int, distance_m: float, dt_s: float = 1 / 30, v_m_s: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Wander through a room of 10 x 3 m. Return the motion (N, 3) of each step and the exact pose (N, 3) after it."""
    rng = np.random.default_rng(seed)
    pose, omega = np.zeros(3), 0.0
    deltas, poses = [], []
    for _ in range(round(distance_m / (v_m_s * dt_s))):
        omega += rng.normal(0.0, 0.3) - 0.1 * omega
        if not (-4.5 < pose[0] < 4.5 and -1.0 < pose[1] < 1.0):
            omega = float(2.0 * np.clip(geometry.wrap_angle(np.arctan2(-pose[1], -pose[0]) - pose[2]), -1.0, 1.0))
        deltas.append(arc(v_m_s, omega, dt_s))
        pose = geometry.compose(pose, deltas[-1])
        poses.append(pose)
    return np.array(deltas), np.array(poses)
