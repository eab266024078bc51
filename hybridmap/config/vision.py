"""Settings of the visual side."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from hybridmap.config.agreement import AgreementConfig
from hybridmap.config.laser import LaserConfig
from hybridmap.config.rgbd import RgbdConfig
from hybridmap.config.section import Section


class ProfileConfig(Section):
    """The scanline profile (eq. 11): what one frame is boiled down to."""

    width: int = Field(default=64, ge=8, le=1024)
    """b: columns of a profile."""
    bands: int = Field(default=4, ge=1, le=32)
    """Row bands an image is cut into for the `four-band` matching; the seed's modes always use the whole column."""
    normalise: Literal["z", "mean"] = "z"
    """`z`: mean 0 and standard deviation 1; `mean`: divided by its mean (the seed's reading; ranks worse)."""


class MatchingConfig(Section):
    """Comparison of profiles (eq. 12 and 13)."""

    mu_r: float = Field(default=0.7, ge=0, le=1)
    """mu_R, weight of the intensity profile."""
    mu_d: float = Field(default=0.3, ge=0, le=1)
    """mu_D, weight of the depth profile; mu_R + mu_D = 1. A laser has depth only and ignores both."""
    max_shift: int = Field(default=16, ge=0)
    """Largest shift |c| tried, columns; less than the profile's width."""
    g_bar: Literal["templates", "shifts"] = "templates"
    """What g_bar is: the mean of g_min over the stored templates, or the mean of g over the shifts of the pair."""
    c_t: float | None = Field(default=None)
    """Threshold: a match when G < c_t. None: no threshold where candidates are verified, else a moderate one for the mode."""
    sequence: int = Field(default=1, ge=1, le=50)
    """Nodes in a row whose views must match, on average; 1: each view by itself."""


class TemplatesConfig(Section):
    """View templates: when a view is new."""

    threshold: float = Field(default=0.5, gt=0)
    """A view is new when its profile differs by more than this from every template (mean absolute difference)."""
    stable_frames: int = Field(default=3, ge=1)
    """A new view founds a template when it has been new in this many consecutive frames."""
    max_shift: int = Field(default=4, ge=0)
    """Largest shift tried against the templates, columns."""


class RelocalisingConfig(AgreementConfig):
    """A robot that has lost its place (it was carried, or its view fits no node before) is looked for on the whole map."""

    candidates: int = Field(default=5, ge=0)
    """Views of the whole map that are verified for a node, the best first; 0: never look outside the gate."""
    separation: int = Field(default=4, ge=0)
    """They lie at least this many nodes apart."""
    doubtful_m: float = Field(default=0.1, gt=0)
    """A node whose view fits those before it but may slide by more than this (one standard deviation) may be elsewhere, m."""
    doubt_nodes: int = Field(default=40, ge=1)
    """Such a doubt is forgotten after so many nodes."""
    unrecognised_nodes: int = Field(default=16, ge=0)
    """Nodes in a row at places that the map knows, none of them recognised, after which the robot is lost too; 0: never."""
    known_m: float = Field(default=0.7, gt=0)
    """A node this near to an old one, looking the same way, is at a place that the map knows, m."""
    known_deg: float = Field(default=20.0, gt=0)
    """The same for the heading, degrees."""


class VisionConfig(Section):
    """Which sensor closes loops, and how."""

    sensor: str = Field(default="auto", min_length=1)
    """The front-end to map with: `laser`, `rgbd`, `none`, or one that another package adds. `auto` takes laser if the source
    has one, else RGB-D."""
    profile: ProfileConfig = ProfileConfig()
    """Scanline profiles."""
    matching: MatchingConfig = MatchingConfig()
    """Comparison of profiles."""
    templates: TemplatesConfig = TemplatesConfig()
    """View templates."""
    relocalising: RelocalisingConfig = RelocalisingConfig()
    """What a lost robot does (RGB-D)."""
    laser: LaserConfig = LaserConfig()
    """Laser front-end."""
    rgbd: RgbdConfig = RgbdConfig()
    """RGB-D front-end."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if abs(self.matching.mu_r + self.matching.mu_d - 1.0) > 1e-9:
            raise ValueError(f"matching: mu_r + mu_d must be 1, found {self.matching.mu_r + self.matching.mu_d:g}")
        for name, shift in (("matching", self.matching.max_shift), ("templates", self.templates.max_shift)):
            if shift >= self.profile.width:
                raise ValueError(f"{name}.max_shift must be less than profile.width {self.profile.width}, found {shift}")
        return self
