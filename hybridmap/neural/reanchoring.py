"""Re-anchoring: at a loop closure the cells take up the activity that they had at the matched node."""

from __future__ import annotations

from hybridmap.geometry import Array, compose, inverse
from hybridmap.neural.path_integrator import PathIntegrator, Snapshot


class Reanchoring:
    """Recalibrates the path integrator to matched nodes (paper eq. 16) and keeps `odom` continuous all the same.

    The cells jump to the matched node's activity, so that a place known from before has its old place code again. What they
    jump by is taken out of the pose in `odom` (REP-105), so that odometry edges stay odometry.

    Attributes:
        weight: how far the cells are pulled, 0..1; with 0 they are left alone.
    """

    def __init__(self, integrator: PathIntegrator, weight: float) -> None:
        self.weight = weight
        self._integrator = integrator
        self._pose_odom_cells: Array | None = None
        self._activity_at_node: dict[int, Snapshot] = {}

    @property
    def pose_odom_robot(self) -> Array:
        """Pose (3,) decoded from the cells, m and rad, in `odom`, where the drive begins."""
        pose = self._integrator.pose
        return pose if self._pose_odom_cells is None else compose(self._pose_odom_cells, pose)

    def remember(self, node: int) -> None:
        """Keep the cells' activity at a new node: of every node if they are to go back to it, else of the last alone."""
        if self.weight == 0.0:
            self._activity_at_node.clear()
        self._activity_at_node[node] = self._integrator.snapshot()

    def activity_at(self, node: int) -> Snapshot:
        """What was remembered at a node."""
        return self._activity_at_node[node]

    def recalibrate(self, node: int, delta_node_robot: Array) -> None:
        """Pull the cells to the activity of a matched node, moved by the pose (3,) of the robot seen from it."""
        if self.weight == 0.0:
            return
        before = self.pose_odom_robot
        self._integrator.restore(self._activity_at_node[node], self.weight, delta_node_robot)
        self._pose_odom_cells = compose(before, inverse(self._integrator.pose))
