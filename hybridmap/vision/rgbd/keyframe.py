"""What the RGB-D front-end keeps of a frame that became a node."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridmap.streams.rgbd import Camera, RgbdFrame
from hybridmap.vision.profile import Profile
from hybridmap.vision.rgbd.depth_grid import Surface, reduced
from hybridmap.vision.rgbd.features import Features

NEAREST_M, FARTHEST_M = 1e-6, 1e6
"""Depth beyond these is none: 0, NaN or Inf."""


@dataclass(frozen=True, slots=True)
class WorkingImage:
    """A frame reduced to the width at which features and depth are processed (the working width).

    Attributes:
        grey: (H, W) uint8.
        depth_m: (H, W) float32, m; 0 where invalid.
    """

    grey: NDArray[np.uint8]
    depth_m: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Keyframe:
    """What is kept of a node's RGB-D image.

    Attributes:
        profile: (bands, width) means of intensity and depth in columns of the image, with which similar views are found.
        features: keypoints with their points in space.
        surface: points and normals of the depth image, on a coarse grid, in `base_link`.
    """

    profile: Profile
    features: Features
    surface: Surface

    @property
    def held(self) -> bool:
        """Whether the camera counts as hand-held: its tilt was estimated at this keyframe, and not taken from the mounting."""
        return self.surface.stance.held


def working_factor(camera: Camera, max_width_px: int) -> int:
    """Least whole factor by which images are reduced so that they are at most `max_width_px` wide."""
    return max(1, -(-camera.width_px // max_width_px))


def working_camera(camera: Camera, max_width_px: int) -> Camera:
    """Pinhole of the images after they are reduced by `working_factor`."""
    return reduced(camera, working_factor(camera, max_width_px))


def working_image(frame: RgbdFrame, factor: int) -> WorkingImage:
    """Reduce a frame by a whole factor; columns and rows that are left over are cut off.

    Grey is averaged over areas. Depth is taken from the pixel in the middle: averaging would invent surfaces at edges.
    Negative depth, NaN and Inf become 0 (none).
    """
    import cv2

    grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    depth = np.asarray(cv2.copyTo(frame.depth_m, cv2.inRange(frame.depth_m, NEAREST_M, FARTHEST_M)), dtype=np.float32)
    if factor > 1:
        height, width = grey.shape[0] // factor, grey.shape[1] // factor
        grey = cv2.resize(grey[: height * factor, : width * factor], (width, height), interpolation=cv2.INTER_AREA)
        half = factor // 2
        depth = np.ascontiguousarray(depth[half::factor, half::factor][:height, :width])
    return WorkingImage(grey, depth)
