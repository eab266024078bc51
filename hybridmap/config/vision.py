"""Settings of the visual side: scanline profiles, loop closure by laser and by RGB-D camera, and a lost robot."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from hybridmap.config.section import Section


class ProfileConfig(Section):
    """The scanline profile (eq. 11): what one frame is boiled down to."""

    width: int = Field(default=64, ge=16, le=1024)
    """b: columns of a profile, or bearings of a laser's.

    Watch: a quarter of it is the largest shift tried between two views; the search costs time in proportion to its square."""
    bands: int = Field(default=4, ge=1, le=32)
    """Row bands an image is cut into for the `four-band` matching.

    Watch: the paper's modes always use the whole column."""
    normalise: Literal["z", "mean"] = "z"
    """`z`: mean 0 and standard deviation 1; `mean`: divided by its mean.

    Watch: `mean` ranks worse."""

    @property
    def max_shift(self) -> int:
        """Largest shift |c| tried between two views, columns."""
        return self.width // 4


class MatchingConfig(Section):
    """Comparison of profiles (eq. 12 and 13)."""

    mu_r: float = Field(default=0.7, ge=0, le=1)
    """mu_R, weight of the intensity profile; that of the depth profile is mu_D = 1 - mu_R.

    Watch: a laser has depth only and ignores it."""
    g_bar: Literal["templates", "shifts"] = "templates"
    """What g_bar is: the mean of g_min over the stored templates, or the mean of g over the shifts of the pair."""
    c_t: float | None = Field(default=None)
    """Threshold: a match when G < c_t. None: no threshold where candidates are verified, else a moderate one for the mode.

    Watch: its scale is another one in each mode."""
    sequence: int = Field(default=1, ge=1, le=50)
    """Nodes in a row whose views must match, on average; 1: each view by itself.

    Watch: a place that is passed only briefly, or the other way round, is then not found."""

    @property
    def mu_d(self) -> float:
        """mu_D, weight of the depth profile."""
        return round(1.0 - self.mu_r, 12)


class TrackingConfig(Section):
    """Refined self-motion: each new node is registered to the last ones, by laser or camera."""

    enabled: bool = True
    """Whether it is done.

    Watch: without it the map between closures is that of the wheels."""


class ClosingConfig(Section):
    """Loop closure, by laser or camera."""

    gate_sigmas: float = Field(default=2.5, gt=0)
    """Width of the gate in standard deviations of the map's uncertainty.

    Watch: a wide gate takes time and lets places in that only look alike; a narrow one loses loops after long drift. A laser
    takes the deviations four times as large; a camera has them once its gate has grown by 10 m."""
    revisit_rounds: int = Field(default=2, ge=0)
    """How often, at the end, nodes that lie near each other on the optimised map are registered; 0: never.

    Watch: each round costs time in proportion to the nodes at places that were seen twice."""


class RelocalisingConfig(Section):
    """A robot that was kidnapped, or recognises nothing where it should, is looked for on the whole map."""

    enabled: bool = True
    """Whether the robot may be lost at all.

    Watch: without it a kidnapped robot bends the map."""


class ScanConfig(Section):
    """What is taken from one scan."""

    templates: bool = True
    """Whether every scan is compared with the view templates.

    Watch: the rule `novelty` of nodes needs it; otherwise it only costs time."""


class ProbeConfig(Section):
    """Hypotheses of loop closure: submaps of the last metres against old submaps inside the gate."""

    every_m: float = Field(default=2.0, gt=0)
    """Travel between two searches for loops, m.

    Watch: half of it costs about twice the time of matching."""
    fit_min: float = Field(default=0.7, gt=0, le=1)
    """Least share of inliers among the points that lie near the old submap.

    Watch: from 0.01 to 0.99 the map of fr079 hardly changes (see results): what a loose one lets in, clusters and the robust
    back-end throw out."""


class LaserConfig(Section):
    """Submap registration and commitment by cluster."""

    scan: ScanConfig = ScanConfig()
    """One scan."""
    probes: ProbeConfig = ProbeConfig()
    """Hypotheses of loop closure."""
    dense_trajectory: bool = True
    """Register every scan to the final map, at the end.

    Watch: it takes time for every scan; without it the way between nodes is that of the wheels."""


class RegistrationConfig(Section):
    """Registration of depth."""

    depth_sigma: float = Field(default=0.003, gt=0)
    """Noise of depth: standard deviation in m at 1 m; it grows with the square of the distance.

    Watch: too small, and edges claim to be surer than they are."""


class PnpConfig(Section):
    """Verification of a loop candidate by features and depth."""

    min_inliers: int = Field(default=12, ge=4)
    """Fewest keypoints that agree.

    Watch: from 4 to 400 the map of the office hardly changes (see results); a strict one leaves less to hold drift."""


class RgbdClosingConfig(Section):
    """Loop closure: gate and candidates."""

    min_age_s: float = Field(default=10.0, ge=0)
    """Nodes younger than this are no loops, s."""
    gate_m: float = Field(default=2.5, gt=0)
    """Radius of the gate right after a closure, m; it grows by 10 % of the travel since then, by 10 m at most.

    Watch: candidates beyond it are not looked at."""
    candidates: int = Field(default=5, ge=1)
    """Candidates verified for a node, best profile first.

    Watch: each costs some milliseconds."""


class RgbdConfig(Section):
    """Scanline profiles, features, depth registration."""

    matching: Literal["literal", "ratio", "signed", "plain", "four-band"] = "four-band"
    """How candidates are ranked: the paper's single-band profile with G read in one of four ways, or four row bands.

    Watch: `literal` is inverted, see [the paper](paper.md)."""
    verify: Literal["none", "pnp"] = "pnp"
    """`pnp`: features and depth, both ways; `none`: the edge is the profile's shift alone (yaw, no translation).

    Watch: with `none` most loops are false."""
    tilt: Literal["auto", "level", "floor"] = "auto"
    """`level`: the camera sits as mounted; `floor`: its tilt and height are measured in each keyframe (hand-held);
    `auto`: level until a floor is seen that contradicts the mounting."""
    max_width_px: int = Field(default=320, ge=80)
    """Images are reduced by a whole factor until they are no wider, pixels.

    Watch: features cost time in proportion to the pixels."""
    held_images: int = Field(default=100, ge=1)
    """Newest nodes whose images stay in memory; the map file has all of them.

    Watch: an image of 640 x 480 takes 2 MB."""
    registration: RegistrationConfig = RegistrationConfig()
    """Registration of depth."""
    pnp: PnpConfig = PnpConfig()
    """Verification."""
    closing: RgbdClosingConfig = RgbdClosingConfig()
    """Gate and candidates."""


class VisionConfig(Section):
    """Which sensor closes loops, and how."""

    sensor: str = Field(default="auto", min_length=1)
    """The sensor to map with: `laser`, `rgbd`, `none`, or a front-end that a package adds; `auto` takes the first kind of
    sensor that the source has.

    Watch: `none` is dead reckoning."""
    profile: ProfileConfig = ProfileConfig()
    """Scanline profiles."""
    matching: MatchingConfig = MatchingConfig()
    """Comparison of profiles."""
    tracking: TrackingConfig = TrackingConfig()
    """Refined self-motion."""
    closing: ClosingConfig = ClosingConfig()
    """Loop closure."""
    relocalising: RelocalisingConfig = RelocalisingConfig()
    """What a lost robot does, by laser or camera."""
    laser: LaserConfig = LaserConfig()
    """Laser front-end."""
    rgbd: RgbdConfig = RgbdConfig()
    """RGB-D front-end."""
