"""Trajectories as text: TUM and KITTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridmap.export.view import SessionView
from hybridmap.metrics import Metric
from hybridmap.output import write_text
from hybridmap.trajectory import write_tum


def write_tum_trajectory(view: SessionView, path: Path) -> list[Metric]:
    """`stamp x y z qx qy qz qw` of `base_link` in `map` at every stamp; s and m."""
    write_tum(path, view.trajectory)
    return [Metric("poses/tum", len(view.trajectory), "1", "poses written")]


def write_kitti_trajectory(view: SessionView, path: Path) -> list[Metric]:
    """The upper 3x4 of `T_map_base`, row by row, a line a stamp (the stamps are those of the `tum` export); z points up."""
    poses = view.trajectory.poses
    cos, sin, zero, one = np.cos(poses[:, 2]), np.sin(poses[:, 2]), np.zeros(len(poses)), np.ones(len(poses))
    rows = np.stack([cos, -sin, zero, poses[:, 0], sin, cos, zero, poses[:, 1], zero, zero, one, zero], axis=1)
    write_text(path, "".join(" ".join(f"{value + 0.0:.17g}" for value in row) + "\n" for row in rows))
    return [Metric("poses/kitti", len(poses), "1", "poses written")]
