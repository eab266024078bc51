"""Settings of the RGB-D front-end."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from hybridmap.config.section import Section


class FeaturesConfig(Section):
    """Keypoints of a keyframe."""

    count: int = Field(default=500, ge=50)
    """Largest number of ORB keypoints."""
    fast_threshold: int = Field(default=10, ge=1)
    """Contrast that a FAST corner needs, grey levels."""
    ratio: float = Field(default=0.8, gt=0, le=1)
    """Lowe's ratio: the best match must be this much nearer than the second."""


class RegistrationConfig(Section):
    """Point-to-plane registration of consecutive keyframes."""

    enabled: bool = True
    """Register each node to the ones before it."""
    back: int = Field(default=2, ge=1, le=8)
    """How many earlier nodes a new one is registered to."""
    grid_px: int = Field(default=5, ge=2)
    """Depth is averaged over, and sampled at, cells of so many pixels (at the working width)."""
    grid_columns: int = Field(default=48, ge=8)
    """Cells are smaller where a picture is too narrow for so many columns of them."""
    iterations: int = Field(default=10, ge=1)
    """Gauss-Newton steps."""
    max_distance_m: float = Field(default=0.15, gt=0)
    """Points farther from the other surface than this (plus the noise of depth) do not count."""
    max_normal_deg: float = Field(default=30.0, gt=0, le=90)
    """Normals of matched points may differ by this much."""
    depth_sigma: float = Field(default=0.003, gt=0)
    """Noise of depth: standard deviation in m at 1 m; it grows with the square of the distance."""
    min_points: int = Field(default=60, ge=10)
    """Fewest matched points."""
    min_inliers: float = Field(default=0.5, gt=0, le=1)
    """Least share of the points in common view that fit."""
    keypoints: bool = True
    """Matched keypoints join the depth: they hold the direction in which depth slides."""
    keypoint_reach_m: float = Field(default=0.3, gt=0)
    """Matched keypoints farther apart than this at the first guess are no matches."""
    correlation: float = Field(default=30.0, ge=1)
    """Where it is asked whether surfaces hold each other or slide, so many neighbouring points count as one."""
    noise_factor: float = Field(default=10.0, ge=1)
    """What the residuals' covariance is multiplied by, until closures of consecutive registrations have shown by how much."""
    translation_floor_m: float = Field(default=0.0001, gt=0)
    """Floor of the standard deviation of a consecutive edge of a mounted camera, m."""
    rotation_floor_deg: float = Field(default=0.005, gt=0)
    """Floor of the standard deviation of a consecutive edge of a mounted camera, degrees."""
    held_translation_floor_m: float = Field(default=0.002, gt=0)
    """The same for a camera whose tilt comes from the floor plane, m."""
    held_rotation_floor_deg: float = Field(default=0.06, gt=0)
    """The same for a camera whose tilt comes from the floor plane, degrees."""
    contradiction_sigma: float = Field(default=8.0, gt=0)
    """A good registration that differs from odometry by more than this many sigma contradicts it."""

    def cell_px(self, width_px: int) -> int:
        """Side of a cell at a working width, pixels."""
        return max(2, min(self.grid_px, width_px // self.grid_columns))

    def floors(self, held: bool) -> tuple[float, float]:
        """Floors of a consecutive edge, m and degrees."""
        if held:
            return self.held_translation_floor_m, self.held_rotation_floor_deg
        return self.translation_floor_m, self.rotation_floor_deg


class PnpConfig(Section):
    """Verification of a loop candidate by features and depth."""

    min_inliers: int = Field(default=12, ge=4)
    """Fewest keypoints that agree."""
    min_inliers_alone: int = Field(default=30, ge=4)
    """Fewest where there is too little depth in common view to refine on."""
    reprojection_px: float = Field(default=3.0, gt=0)
    """An inlier's largest reprojection error, pixels (at the working width)."""
    iterations: int = Field(default=200, ge=1)
    """RANSAC draws at most."""
    max_height_m: float = Field(default=0.1, gt=0)
    """The robot stays on the floor: largest |dz|, m (three times as much where the tilt comes from the floor plane)."""
    max_tilt_deg: float = Field(default=3.0, gt=0)
    """Largest tilt out of the floor, degrees (twice as much where the tilt comes from the floor plane)."""
    agree_m: float = Field(default=0.1, gt=0)
    """The two directions must give the same pose within this, m."""
    agree_deg: float = Field(default=2.0, gt=0)
    """The two directions must give the same heading within this, degrees."""
    refine: bool = True
    """Refine jointly on keypoints and depth."""
    map_inliers: float = Field(default=0.8, gt=0, le=1)
    """By depth alone, from the map's guess: least share of the points in common view that fit."""
    map_overlap: float = Field(default=0.35, gt=0, le=1)
    """By depth alone: least share of a keyframe's points that the other one sees."""
    map_points: int = Field(default=150, ge=10)
    """By depth alone: fewest matched points."""
    map_sigma_m: float = Field(default=0.05, gt=0)
    """By depth alone: largest standard deviation in the loosest direction, m."""
    translation_floor_m: float = Field(default=0.0001, gt=0)
    """Floor of the standard deviation of a loop edge of a mounted camera, m."""
    rotation_floor_deg: float = Field(default=0.005, gt=0)
    """Floor of the standard deviation of a loop edge of a mounted camera, degrees."""
    held_translation_floor_m: float = Field(default=0.01, gt=0)
    """The same for a camera whose tilt comes from the floor plane, m."""
    held_rotation_floor_deg: float = Field(default=0.2, gt=0)
    """The same for a camera whose tilt comes from the floor plane, degrees."""

    def floors(self, held: bool) -> tuple[float, float]:
        """Floors of a loop edge, m and degrees."""
        if held:
            return self.held_translation_floor_m, self.held_rotation_floor_deg
        return self.translation_floor_m, self.rotation_floor_deg


class RgbdClosingConfig(Section):
    """Loop closure: gate, candidates, support."""

    min_age_s: float = Field(default=10.0, ge=0)
    """Nodes younger than this are no loops."""
    gate_m: float = Field(default=2.5, gt=0)
    """Radius of the gate right after a closure, m."""
    gate_per_m: float = Field(default=0.1, ge=0)
    """Growth of the gate per metre travelled since the last closure."""
    gate_growth_m: float = Field(default=10.0, ge=0)
    """Largest growth of the gate, m."""
    gate_sigma: float = Field(default=2.5, ge=0)
    """The gate is never less than this many standard deviations of the map's own uncertainty."""
    heading_deg: float = Field(default=50.0, gt=0, le=180)
    """Headings may differ by this much (plus `heading_deg_per_m`); beyond the field of view nothing is seen in common."""
    heading_deg_per_m: float = Field(default=0.3, ge=0)
    """Growth of the heading gate per metre travelled since the last closure, degrees."""
    candidates: int = Field(default=5, ge=1)
    """Candidates verified for a node, best profile first."""
    accept: int = Field(default=2, ge=1)
    """Edges that may enter for a node."""
    separation: int = Field(default=2, ge=0)
    """Candidates lie at least this many nodes apart."""
    support_nodes: int = Field(default=12, ge=0)
    """An edge needs another one that agrees, from a node within so many, to a node within so many; 0: none needed."""
    pending_nodes: int = Field(default=40, ge=1)
    """A verified edge without support is given up after so many nodes."""
    shift_sigma_m: float = Field(default=0.7, gt=0)
    """Unverified edges: standard deviation of the translation, m."""
    shift_sigma_deg: float = Field(default=6.0, gt=0)
    """Unverified edges: standard deviation of the heading, degrees."""
    repropose_m: float = Field(default=2.0, ge=0)
    """At the end, nodes this near on the optimised map are tried again, by features and then by depth alone; 0: no."""
    repropose_rounds: int = Field(default=2, ge=0)
    """How often, each time on the map as it has become."""
    repropose_sigma_m: float = Field(default=0.15, gt=0)
    """By depth alone: how far the map may be off, m (one standard deviation)."""
    repropose_sigma_deg: float = Field(default=3.0, gt=0)
    """By depth alone: how far the map may be off, degrees."""
    repropose_per_node: int = Field(default=2, ge=1)
    """Candidates tried for a node."""
    repropose_online: int = Field(default=1, ge=0)
    """While driving, earlier nodes tried again with each new one, once a closure has moved them; 0: none."""


class RgbdConfig(Section):
    """Scanline profiles, features, depth registration."""

    matching: Literal["literal", "ratio", "signed", "plain", "four-band"] = "four-band"
    """How candidates are ranked: the seed's single-band profile with G read in one of four ways, or four row bands."""
    verify: Literal["none", "pnp"] = "pnp"
    """`pnp`: features and depth, both ways; `none`: the edge is the profile's shift alone (yaw, no translation)."""
    tilt: Literal["auto", "level", "floor"] = "auto"
    """`level`: the camera sits as mounted; `floor`: its tilt and height are measured in each keyframe (hand-held);
    `auto`: level until a floor is seen that contradicts the mounting."""
    max_width_px: int = Field(default=320, ge=80)
    """Images are reduced by a whole factor until they are no wider."""
    held_images: int = Field(default=100, ge=1)
    """Newest nodes whose images stay in memory; the map file has all of them."""
    features: FeaturesConfig = FeaturesConfig()
    """Keypoints."""
    registration: RegistrationConfig = RegistrationConfig()
    """Consecutive keyframes."""
    pnp: PnpConfig = PnpConfig()
    """Verification."""
    closing: RgbdClosingConfig = RgbdClosingConfig()
    """Loop closure."""
