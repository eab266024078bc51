"""Settings of the vision stage: scanline profiles, loop closure by laser and RGB-D camera, and global localisation."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from hybridmap.config.section import Section


class ProfileConfig(Section):
    """The scanline profile (eq. 11 of the paper): the short vector that describes one camera frame or laser scan."""

    width: int = Field(default=64, ge=16, le=1024)
    """b: columns of a profile, or bearings of a laser's.

    Watch: a quarter of the width is the largest shift tried between two views; the time of the search grows with its square.
    """
    bands: int = Field(default=4, ge=1, le=32)
    """Row bands into which an image is cut for `four-band` matching.

    Watch: the other kinds of `vision.rgbd.matching` always use the whole column.
    """
    normalise: Literal["z", "mean"] = "z"
    """`z`: mean 0 and standard deviation 1; `mean`: divided by its mean.

    Watch: `mean` ranks worse. A laser ignores it: its profile is always normalised by `z`.
    """

    @property
    def max_shift(self) -> int:
        """Largest column shift |c| tried when two profiles are compared, columns."""
        return self.width // 4


class MatchingConfig(Section):
    """How the scanline profiles of two views are compared (eqs. 12 and 13 of the paper)."""

    mu_r: float = Field(default=0.7, ge=0, le=1)
    """mu_R, weight of the intensity profile; that of the depth profile is mu_D = 1 - mu_R.

    Watch: a laser has depth only and ignores it."""
    g_bar: Literal["templates", "shifts"] = "templates"
    """Definition of g_bar: the mean of g_min over the stored templates, or the mean of g over the shifts of the pair."""
    c_t: float | None = Field(default=None, ge=-1e6, le=1e6)
    """Threshold: two views match if their score G is below c_t. None: with `vision.closing.by: scanline` it is found from the
    drive; with `ratslam` it is that of view templates, 0.5; without, there is none if matches are verified by features, else a
    moderate one by `vision.rgbd.matching`.

    Watch: the scale of G differs between the readings of `vision.rgbd.matching`. With `ratslam` it is a difference, above 0.
    """
    sequence: int = Field(default=1, ge=1, le=50)
    """Consecutive nodes whose views must match, on average; 1: each view by itself.

    Watch: with more, places that are passed briefly or in the other direction are not found.
    """

    @property
    def mu_d(self) -> float:
        """mu_D = 1 - mu_R, weight of the depth profile."""
        return round(1.0 - self.mu_r, 12)


class TrackingConfig(Section):
    """Correction of odometry: each new node is registered to the previous ones, by laser or camera."""

    enabled: bool = True
    """Whether new nodes are registered.

    Watch: without it, wheel odometry alone makes the map between loop closures.
    """


class ClosingConfig(Section):
    """Search for loop closures by laser or camera."""

    by: Literal["geometry", "proximity", "scanline", "ratslam", "nothing"] = "geometry"
    """`geometry`: profiles propose loops, scans, features and depth are registered to each other, and measure motion and loops;
    `proximity`: the same, but no profile proposes a loop unless the robot is lost (for comparison); `scanline`: the paper's
    means alone, profiles that match along a stretch of the way (`vision.matching.sequence`); `ratslam`: RatSLAM's view cells
    and pose cells; `nothing`: registrations measure motion as with `geometry`, and no loop is closed.

    Watch: with `scanline` and `ratslam` the map between loops is that of the wheels, a robot that was carried is not found, and
    of `vision` only `sensor`, `profile`, `matching` and, by `ratslam`, `closing.gate_sigmas` are read. `nothing` ignores
    `vision.relocalising.enabled`, too: a robot that was carried is not found.
    """
    gate_sigmas: float = Field(default=2.5, gt=0, le=100)
    """Older nodes are considered for a loop within this many standard deviations of the pose uncertainty on the map (the gate).

    Watch: a wide gate takes time and admits places that only look alike; a narrow one loses loops after long drift. A laser
    multiplies the deviations by four; a camera uses them only after its gate has grown by 10 m. With `ratslam` it is the
    distance of two places on the pose cells, in cells, within which they are one: a packet deviates by about a cell.
    """
    revisit_rounds: int = Field(default=2, ge=0, le=100)
    """How many times, at the end, nodes that lie close together on the optimised map are registered to each other; 0: never.

    Watch: the time of a round grows with the number of nodes at places that were visited twice.
    """


class RelocalisingConfig(Section):
    """Global localisation: a robot that was kidnapped, or recognises nothing, is searched for on the whole map."""

    enabled: bool = True
    """Whether global localisation is used.

    Watch: without it a kidnapped robot bends the map.
    """


class ScanConfig(Section):
    """What single laser scans are used for, besides submaps."""

    templates: bool = True
    """Whether every scan is compared with the view templates.

    Watch: the node rule `views` needs it, `novelty` and `passage` have the place code alone without; otherwise it only costs
    time.
    """


class ProbeConfig(Section):
    """Search for loops by laser: the submap of the last metres is matched with old submaps that the drift allows."""

    every_m: float = Field(default=2.0, gt=0, le=1000)
    """Travel between two searches for loops, m.

    Watch: half the distance takes about twice the time for matching.
    """
    fit_min: float = Field(default=0.7, gt=0, le=1)
    """Least share of inliers among the points of the new submap that lie near the old one.

    Watch: from 0.01 to 0.99 the map of fr079 hardly changes (see results): the cluster test and the robust back-end reject
    false hypotheses.
    """


class LaserConfig(Section):
    """Loop closure by laser: submaps are registered to each other, and loops that agree are accepted in clusters."""

    scan: ScanConfig = ScanConfig()
    """Use of single scans."""
    probes: ProbeConfig = ProbeConfig()
    """Loop hypotheses."""
    dense_trajectory: bool = True
    """Register every scan to the final map, at the end.

    Watch: it takes time for every scan; without it the trajectory between nodes is wheel odometry.
    """


class RegistrationConfig(Section):
    """Noise of the depth by which two RGB-D frames are registered."""

    depth_sigma: float = Field(default=0.003, ge=1e-6, le=10)
    """Noise of depth: standard deviation in m at 1 m; it grows with the square of the distance.

    Watch: too small a value gives edges too small a covariance.
    """


class PnpConfig(Section):
    """Verification of a loop candidate by visual features and depth (perspective-n-point)."""

    min_inliers: int = Field(default=12, ge=4, le=100_000)
    """Least number of matched features that agree with the estimated relative pose (inliers).

    Watch: from 4 to 400 the map of the office hardly changes (see results); with a high number fewer loops limit the drift.
    """


class RgbdClosingConfig(Section):
    """Loop closure by camera: which older nodes are candidates."""

    gate_m: float = Field(default=2.5, gt=0, le=10_000)
    """Radius around the robot within which older nodes are candidates, right after a loop closure, m. It grows by 10 % of the
    travel since then, by at most 10 m.

    Watch: candidates outside are not considered.
    """
    candidates: int = Field(default=5, ge=1, le=10_000)
    """Candidates verified per node, best profile first.

    Watch: each takes some milliseconds.
    """


class RgbdConfig(Section):
    """Mapping with an RGB-D camera: scanline profiles, visual features, depth registration."""

    matching: Literal["literal", "ratio", "signed", "plain", "four-band"] = "four-band"
    """How candidates are ranked: by the paper's single-band profile with one of four readings of G, or by four row bands.

    Watch: `literal` is inverted, see [the paper](paper.md).
    """
    verify: Literal["none", "pnp"] = "pnp"
    """`pnp`: features and depth, in both directions; `none`: the edge is the profile's shift alone (yaw, no translation).

    Watch: with `none` most loops are false.
    """
    tilt: Literal["auto", "level", "floor"] = "auto"
    """`level`: the camera is as mounted; `floor`: tilt and height are measured in each keyframe (hand-held camera);
    `auto`: `level` until a visible floor contradicts the mounting.
    """
    max_width_px: int = Field(default=320, ge=80, le=16_384)
    """Images are reduced by an integer factor until they are at most this wide, pixels.

    Watch: the time for features grows with the pixels.
    """
    registration: RegistrationConfig = RegistrationConfig()
    """Registration of depth."""
    pnp: PnpConfig = PnpConfig()
    """Verification."""
    closing: RgbdClosingConfig = RgbdClosingConfig()
    """Gate and candidates."""


class VisionConfig(Section):
    """The sensor that corrects odometry and closes loops, and its settings."""

    sensor: str = Field(default="auto", min_length=1)
    """The sensor to map with: `laser`, `rgbd`, `none`, or a sensor added by an installed package; `auto` takes the first kind
    that the source has.

    Watch: `none` is dead reckoning.
    """
    profile: ProfileConfig = ProfileConfig()
    """Scanline profiles."""
    matching: MatchingConfig = MatchingConfig()
    """Comparison of profiles."""
    tracking: TrackingConfig = TrackingConfig()
    """Refined self-motion."""
    closing: ClosingConfig = ClosingConfig()
    """Loop closure."""
    relocalising: RelocalisingConfig = RelocalisingConfig()
    """Global localisation, by laser or camera."""
    laser: LaserConfig = LaserConfig()
    """Laser front-end."""
    rgbd: RgbdConfig = RgbdConfig()
    """RGB-D front-end."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.closing.by == "proximity" and self.rgbd.verify == "none":
            raise ValueError(
                "expected vision.rgbd.verify pnp where vision.closing.by is proximity (no profile gives an edge), found none"
            )
        c_t = self.matching.c_t
        if self.closing.by == "ratslam" and c_t is not None and c_t <= 0.0:
            raise ValueError(f"expected vision.matching.c_t above 0 where vision.closing.by is ratslam, found {c_t:g}")
        return self
