"""Mountings of the sensors on the robot: the constant part of the transform tree."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from hybridmap.errors import StreamError
from hybridmap.geometry import Array, rotation_from_quaternion

_CONSTANT_TOLERANCE = 1e-4  # m, or of a rotation matrix' entries


def clean_frame(frame: str) -> str:
    """A frame's name without the leading slash of old tf."""
    return frame.strip().lstrip("/")


def matrix(translation: tuple[float, float, float], quaternion_xyzw: tuple[float, float, float, float]) -> Array:
    """(4, 4) pose of the child frame in the parent frame, from translation, m, and quaternion x, y, z, w (normalised here)."""
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion(quaternion_xyzw)
    T[:3, 3] = translation
    return T


def invert(T_a_b: Array) -> Array:
    """Inverse (4, 4) of a rigid transform: the pose of frame a in frame b."""
    T = np.eye(4)
    T[:3, :3] = T_a_b[:3, :3].T
    T[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T


def planar(T_a_b: Array) -> Array:
    """(3,) x, y and heading of the x axis of a (4, 4) pose, m and rad."""
    return np.array([T_a_b[0, 3], T_a_b[1, 3], np.arctan2(T_a_b[1, 0], T_a_b[0, 0])])


@dataclass(slots=True)
class _Edge:
    T_parent_child: Array
    is_static: bool
    moves: bool = False


class TransformTree:
    """Frames joined by transforms. Those that stay constant, on `/tf_static` or `/tf`, give the mountings of sensors."""

    def __init__(self) -> None:
        self._edges: dict[tuple[str, str], _Edge] = {}

    def add(self, parent: str, child: str, T_parent_child: Array, *, static: bool) -> None:
        """Add the pose (4, 4) of `child` in `parent`, m.

        A static one replaces whatever is there. Of others the first stays; if a later one differs, the transform counts as
        moving and gives no mounting.
        """
        key = (clean_frame(parent), clean_frame(child))
        edge = self._edges.get(key)
        if edge is None or static:
            self._edges[key] = _Edge(T_parent_child, static)
        elif not edge.is_static:
            edge.moves |= bool(np.abs(edge.T_parent_child - T_parent_child).max() > _CONSTANT_TOLERANCE)

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted({frame for key in self._edges for frame in key})

    def between(self, base: str, sensor: str) -> Array | None:
        """(4, 4) pose of the sensor's frame in the base, m, along constant transforms; None if there is no such path."""
        return self._search(clean_frame(base), clean_frame(sensor), allow_moving=False)

    def _search(self, base: str, sensor: str, *, allow_moving: bool) -> Array | None:
        reached = {base: np.eye(4)}
        queue = deque([base])
        while queue:
            frame = queue.popleft()
            if frame == sensor:
                return reached[frame]
            for (parent, child), edge in sorted(self._edges.items(), key=lambda item: item[0]):
                if edge.moves and not allow_moving:
                    continue
                if parent == frame and child not in reached:
                    reached[child] = reached[frame] @ edge.T_parent_child
                    queue.append(child)
                elif child == frame and parent not in reached:
                    reached[parent] = reached[frame] @ invert(edge.T_parent_child)
                    queue.append(parent)
        return None

    def require(self, base: str, sensor: str, what: str, setting: str) -> Array:
        """(4, 4) pose of the sensor's frame in the base, m, along constant transforms.

        Args:
            base: name of the frame of the base.
            sensor: name of the frame of the sensor.
            what: file and topic, for the error.
            setting: the setting that can replace the transform, for the error.

        Raises:
            StreamError: there is no such path; the message names both frames and the setting.
        """
        found = self.between(base, sensor)
        if found is not None:
            return found
        if self._search(clean_frame(base), clean_frame(sensor), allow_moving=True) is not None:
            raise StreamError(f"{what}: the transform {base!r} -> {sensor!r} moves on /tf; give {setting} in the configuration")
        known = ", ".join(self.frames) or "none"
        raise StreamError(
            f"{what}: no transform {base!r} -> {sensor!r} in /tf_static or /tf (frames found: {known}); "
            f"give {setting} in the configuration"
        )
